"""Webhooks: what happened is told to who wants to know, signed, until it was heard."""
