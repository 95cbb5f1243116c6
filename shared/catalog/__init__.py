"""The catalog: SQLAlchemy tables and queries on PostgreSQL, or SQLite in the embedded mode.

Each module has the tables of one subject and their queries. `database` has the connection layer;
only its `session.Catalog` opens sessions and commits.
"""
