"""Uploads: multipart bodies are parsed and stored while they arrive."""
