"""The synchronous client, made of the asynchronous one: `make client`.

Both are one implementation, written once. Only words differ: `await` is left out, and names are
replaced by those of REPLACED.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
GENERATED_FILES = {
    "shared/client/async_wire.py": "shared/client/wire.py",
    "shared/client/async_calls.py": "shared/client/calls.py",
    "placewise/async_client.py": "placewise/client.py",
}
# In this order: what is replaced first is seen by none of those below it.
REPLACEMENTS = (
    (r"^import asyncio\n", ""),
    (r"asyncio\.sleep", "time.sleep"),
    (r"`(\w+)\.py` is made of this file by `make client`: change this one\.", r"MADE"),
    (r"\bawait ", ""),
    (r"\basync (def|for|with) ", r"\1 "),
    (r"Callable\[\[\], Awaitable\[Answer\]\]", "Callable[[], Answer]"),
    (r"\bAsyncIterator\b", "Iterator"),
    (r", Awaitable\b", ""),
    (r"\b__aenter__\b", "__enter__"),
    (r"\b__aexit__\b", "__exit__"),
    (r"\ba(close|read|iter_bytes)\b", r"\1"),
    (r"\bAsync(Transport|Client|RawClient)\b", r"\1"),
    (r"\basync_(wire|calls|client)\b", r"\1"),
    (r"\bconnect_async\b", "connect"),
    (r"for (\w+) in (.+):\n\s+yield \1$", r"yield from \2"),
    (r"\bThe asynchronous client\b", "The client"),
)


def to_synchronous(source: str) -> str:
    """The text of an asynchronous module as that of its synchronous twin, formatted."""
    text = (ROOT / source).read_text()
    for pattern, word in REPLACEMENTS:
        text = re.sub(pattern, word, text, flags=re.MULTILINE)
    text = text.replace(
        "MADE", f"Made of `{Path(source).name}` by `make client`: change that one, not this.", 1
    )
    return _format_source(text, GENERATED_FILES[source])


def _format_source(text: str, name: str) -> str:
    ruff = shutil.which("ruff", path=Path(sys.executable).parent) or "ruff"
    for arguments in (["check", "--select", "I", "--fix", "--quiet"], ["format", "--quiet"]):
        done = subprocess.run(  # noqa: S603
            [ruff, *arguments, "--stdin-filename", name, "-"],
            input=text,
            capture_output=True,
            text=True,
            check=True,
            cwd=ROOT,
        )
        text = done.stdout
    return text


if __name__ == "__main__":
    for source, made in GENERATED_FILES.items():
        (ROOT / made).write_text(to_synchronous(source))
