"""Registration of the steward's periodic tasks: `@periodic_task` beside the function of each."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., object])


@dataclass(slots=True)
class PeriodicTask:
    """A maintenance task of the scheduler."""

    name: str
    """Its label in the metrics: the name of its function."""
    interval_seconds: float
    """Pause between the end of a run and the next one."""
    run: Callable[[], object]
    """Returns True if the passing of time makes more work due; else a commit has to."""
    own_thread: bool = False
    """Whether it can take so long that the others must not wait for it."""
    counter: str | None = None
    """Counter of `StewardMetrics` to which the number that it returns is added."""
    uses_catalog: bool = True
    """Whether its success shows that the catalog can be reached."""
    next_run: float = field(default=0.0)
    """By `time.monotonic`."""
    commits_seen: int = field(default=-1)
    """`CommitSignal.count` before its last run."""


_REGISTERED: list[tuple[Callable[..., object], dict[str, Any]]] = []


def periodic_task(interval_seconds: float, **options: Any) -> Callable[[Function], Function]:
    """Register a function as a periodic task; `options` are those of `PeriodicTask`.

    The function must be safe to run twice at once, and work in small transactions. Its parameters
    `catalog`, `store`, `wakeups`, `settings`, `retries` and `queued_chunks` are passed by name, as
    far as it has them.
    """

    def register(function: Function) -> Function:
        _REGISTERED.append((function, {"interval_seconds": interval_seconds, **options}))
        return function

    return register


def registered_tasks(resources: Mapping[str, Any]) -> list[PeriodicTask]:
    """Return the registered tasks, with their parameters taken from the resources."""
    tasks = []
    for function, options in _REGISTERED:
        parameters = inspect.signature(function).parameters.keys() & resources.keys()
        run = partial(function, **{parameter: resources[parameter] for parameter in parameters})
        tasks.append(PeriodicTask(function.__name__, run=run, **options))
    return tasks
