"""A program as a client of the fork server: `forked_command` in tests/support/processes.py.

    python -IS forked_program.py SERVER PROGRAM [ARGUMENT]...

The fork has the standard files, environment and folder of this process, which imports little and
ends with the exit code of the fork. The server kills the fork when a signal ends this process.
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
import time
from collections.abc import Sequence
from typing import Any

ANSWER_BYTES = 1024
LOOK_SECONDS = 0.01


def main() -> int:
    server, *command = sys.argv[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as control:
        control.connect(f"\0{server}")
        start = {"command": command, "env": dict(os.environ), "cwd": os.getcwd()}  # noqa: PTH109
        pid = ask(control, start, [0, 1, 2])
        assert pid is not None
        select.select([os.pidfd_open(pid)], [], [])
        while (code := ask(control, {"ended": pid})) is None:
            time.sleep(LOOK_SECONDS)
    return code if code >= 0 else 128 - code  # as a shell reports a signal


def ask(
    control: socket.socket, request: dict[str, Any], descriptors: Sequence[int] = ()
) -> int | None:
    socket.send_fds(control, [json.dumps({**request, "number": 0}).encode()], descriptors)
    answer = control.recv(ANSWER_BYTES)
    if not answer:
        raise EOFError("the fork server has ended")
    number: int | None = json.loads(answer)[1]
    return number


if __name__ == "__main__":
    sys.exit(main())
