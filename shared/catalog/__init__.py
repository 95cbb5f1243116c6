"""The catalog: SQLAlchemy tables and queries on PostgreSQL, or SQLite in the embedded mode.

Each module has the tables of one subject and their queries. Only `session.Catalog` opens sessions
and commits.
"""
