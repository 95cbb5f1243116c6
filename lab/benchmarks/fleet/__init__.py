"""Starts a complete Placewise on this machine: real servers, and each service in its own process.

    with open_fleet(extractors=3) as fleet:
        fleet.start()
        fleet["extractor-1"].kill()

The benchmarks and the fault-injection suite use it. It needs a checkout with the extra `dev`,
because the servers are those of the tests.
"""

from lab.benchmarks.fleet.fleet import Fleet, Servers, open_fleet, start_servers
from lab.benchmarks.fleet.service import ServiceProcess

__all__ = ["Fleet", "Servers", "ServiceProcess", "open_fleet", "start_servers"]
