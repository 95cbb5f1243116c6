"""The trainer: GSV-Cities training of place models, and their evaluation."""
