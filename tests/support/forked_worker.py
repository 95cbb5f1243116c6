"""A worker of pytest-xdist as a fork: what execnet runs with `python -c`.

Processes that a test spawns import the main module again, without running a worker.
"""

import sys

if __name__ == "__main__":
    exec(eval(sys.stdin.readline()))
