"""Training and evaluating place descriptors: `placewise train`, `evaluate`, `compare`."""
