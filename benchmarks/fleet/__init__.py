"""A whole Placewise on this machine: real servers, every service in processes of its own.

    with start_servers() as servers, Fleet(folder, servers, extractors=3) as fleet:
        fleet.start()
        fleet["extractor-1"].kill()

The benchmarks and the fault suite run on it. It needs a checkout with the dev extra: the servers
are those of the tests.
"""

from benchmarks.fleet.fleet import Fleet, Servers, start_servers
from benchmarks.fleet.service import ServiceProcess

__all__ = ["Fleet", "Servers", "ServiceProcess", "start_servers"]
