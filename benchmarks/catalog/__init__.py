"""Benchmark of the catalog: explains every SQL statement of the services on a large database.

`fill` creates the data, `command` calls the services' own functions, `explain` captures and
explains the statements that these functions send. The statements are therefore complete and
identical to those in production.
"""
