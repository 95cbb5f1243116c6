"""Configuration of Celery's tools, such as Flower, which CELERY_CONFIG_MODULE names.

With it, Flower's Broker page shows these queues from the first minute. The image of Flower has no
other package of Placewise: this module imports none.
"""

from __future__ import annotations

from kombu.entity import Queue

QUEUES = ("placewise.query", "placewise.bulk", "placewise.model")

task_queues = [Queue(name) for name in QUEUES]  # type: ignore[no-untyped-call]
task_default_queue = QUEUES[1]
