"""Observability: logs, traces, metrics, heartbeats, and the request id that correlates them."""
