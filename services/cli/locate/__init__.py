"""`placewise locate`: positions for the photos of a folder that have none."""
