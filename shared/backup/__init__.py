"""Backups: a folder that holds a whole Placewise, catalog and objects, and can become one again.

The catalog's rows are JSON lines, table by table: they go from SQLite and PostgreSQL into either.
Objects are files under their keys. No other program is needed for any of it.

**Which first, catalog or objects?** Objects are written once and named by rows that come later, and
go away before or after their rows. So neither order is right alone: objects copied first lack what
came meanwhile, and a catalog read first names what is gone meanwhile. A backup copies all objects
(the long part), then reads the catalog in one consistent snapshot, then copies what that names and
is not there yet (the short part). Where something of that was deleted or merged away in between, it
reads the catalog anew; the second time little is left to copy.
"""
