"""The steward keeps the store healthy. One module per duty; `loop` says how often each is done.

Every duty may run twice at once, in two processes: what it changes is locked or checked again
inside its transaction.
"""
