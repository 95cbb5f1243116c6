"""What the services export, by the registries that they really fill."""

from __future__ import annotations

from prometheus_client import CollectorRegistry
from prometheus_client.parser import text_string_to_metric_families

# What Prometheus adds by itself.
ADDED = frozenset({"up"})


def exported(registry: CollectorRegistry) -> dict[str, frozenset[str]]:
    """Of each sample's name, also where nothing was counted yet, the names of its labels."""
    names: dict[str, set[str]] = {}
    for family in registry.collect():
        for sample in family.samples:
            names.setdefault(sample.name, set()).update(sample.labels)
    # Metrics with labels have no sample before they are counted: ask them by their declaration.
    for collector in list(registry._collector_to_names):
        labels = getattr(collector, "_labelnames", ())
        for name in registry._collector_to_names[collector]:
            names.setdefault(name, set()).update(labels)
    return {name: frozenset(labels) for name, labels in names.items()}


def read(text: str) -> dict[str, dict[tuple[tuple[str, str], ...], float]]:
    """Prometheus' text format: the values of each sample by their labels."""
    values: dict[str, dict[tuple[tuple[str, str], ...], float]] = {}
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            values.setdefault(sample.name, {})[tuple(sorted(sample.labels.items()))] = sample.value
    return values
