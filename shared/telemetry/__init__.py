"""What a running Placewise tells of itself: logs, traces, and the id that leads from a request
through its jobs to a chunk."""
