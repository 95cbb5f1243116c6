"""Place estimates, located photos and tracks."""
