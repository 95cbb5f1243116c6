"""The catalog: what exists, in PostgreSQL (or SQLite when embedded).

One module per table, with the table's queries beside it. `session.Catalog` is the only place that
opens a session and the only place that commits.
"""
