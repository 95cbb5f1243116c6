"""Readers for uploaded zip and tar archives in the object store."""
