"""The fault suite: photos are uploaded and asked for while parts die, then everything is counted.

    placewise bench chaos --photos 2000 --seconds 600 --seed 1

`faults` says what goes wrong, `traffic` uploads and asks meanwhile, `audit` counts, `run` does one
fault after the other.
"""

from benchmarks.chaos.run import Report, run_chaos

__all__ = ["Report", "run_chaos"]
