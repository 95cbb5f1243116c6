"""Interface of the search tier: messages, HTTP client, and directory of search workers."""
