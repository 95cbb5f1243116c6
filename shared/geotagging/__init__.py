"""Positions of photos without coordinates, from the picture, time neighbours and GPX tracks."""
