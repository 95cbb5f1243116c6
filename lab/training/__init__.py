"""The trainer: metric-learning training of place descriptors on GSV-Cities, and validation."""
