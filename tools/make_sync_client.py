"""Generates the synchronous client from the asynchronous one: `make client`.

Both forms share one implementation: the generator removes `await` and replaces names according to
REPLACEMENTS.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
GENERATED_FILES = {
    "placewise/async_transport.py": "placewise/transport.py",
    "placewise/async_client.py": "placewise/client.py",
}
# Applied in this order, each to the result of the ones before.
REPLACEMENTS = (
    (r"^import asyncio\n", ""),
    (r"asyncio\.sleep", "time.sleep"),
    (r"`(\w+)\.py` is generated from this file by `make client`\. Edit this file\.", r"NOTICE"),
    (r"\bawait ", ""),
    (r"\basync (def|for|with) ", r"\1 "),
    (r"Callable\[\[\], Awaitable\[Answer\]\]", "Callable[[], Answer]"),
    (r"\bAsyncIterator\b", "Iterator"),
    (r", Awaitable\b", ""),
    (r"\b__aenter__\b", "__enter__"),
    (r"\b__aexit__\b", "__exit__"),
    (r"\ba(close|read|iter_bytes)\b", r"\1"),
    (r"\bAsync(Transport|Client)\b", r"\1"),
    (r"\basync_(transport|client)\b", r"\1"),
    (r"\bconnect_async\b", "connect"),
    (r"for (\w+) in (.+):\n\s+yield \1$", r"yield from \2"),
    (r"\bThe asynchronous client\b", "The client"),
)


def to_synchronous(source: str) -> str:
    """Convert the source of an asynchronous module to formatted synchronous source."""
    text = (ROOT / source).read_text()
    for pattern, replacement in REPLACEMENTS:
        text = re.sub(pattern, replacement, text, flags=re.MULTILINE)
    text = text.replace(
        "NOTICE", f"Generated from `{Path(source).name}` by `make client`. Edit that file.", 1
    )
    return _format_source(text, GENERATED_FILES[source])


def _format_source(text: str, name: str) -> str:
    ruff = shutil.which("ruff", path=Path(sys.executable).parent) or "ruff"
    for arguments in (["check", "--select", "I", "--fix", "--quiet"], ["format", "--quiet"]):
        result = subprocess.run(  # noqa: S603
            [ruff, *arguments, "--stdin-filename", name, "-"],
            input=text,
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
        )
        text = result.stdout
    return text


if __name__ == "__main__":
    for source, target in GENERATED_FILES.items():
        (ROOT / target).write_text(to_synchronous(source))
