"""`placewise immich`: the photos of an Immich server as a library."""
