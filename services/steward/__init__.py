"""The steward: background maintenance, batch imports, evaluations and webhook deliveries.

`scheduler` defines the periodic tasks and their intervals; `tasks` has a module for each group of
them. Any number of stewards may run: what a task changes is locked, or checked again, inside its
transaction.
"""
