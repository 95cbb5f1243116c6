"""Backups of a whole Placewise, catalog and objects, in a folder, and their restore.

The catalog's rows are JSON lines per table, which can be restored into SQLite or PostgreSQL,
whichever they came from. Objects are files under their keys. No other program is needed.

**Consistency.** Objects are written once, before the rows that reference them, and are deleted
before or after their rows. So copying only in one order is not enough: objects copied first lack
later ones, and a catalog copied first references objects that are deleted meanwhile. A backup
copies all objects (the long part), then reads the catalog in one consistent snapshot, then copies
the objects that it references and that are missing in the backup (the short part). If some of these
were deleted or merged meanwhile, it reads the catalog again; the next pass has little to copy.
"""
