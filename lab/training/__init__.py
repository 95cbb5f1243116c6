"""Metric-learning training of place descriptors on GSV-Cities, and validation."""
