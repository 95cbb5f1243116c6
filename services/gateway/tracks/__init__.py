"""Tracks: their schemas, the map as the filter sees it, and the application of frames."""
