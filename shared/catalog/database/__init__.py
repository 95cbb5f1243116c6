"""The catalog's database: sessions, engines, errors, the schema's migration, and column types."""
