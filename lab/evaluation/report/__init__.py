"""Self-contained HTML reports of evaluation runs, without external resources."""
