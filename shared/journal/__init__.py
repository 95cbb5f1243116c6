"""The journal: the catalog's rows, written to the object store.

A catalog is rebuilt from it (`services.cli.recovery`). It has two parts:

- *Segments* are a log of the tables in `TABLES`. They follow the transactional outbox pattern:
  every transaction that changes a row marks it (`shared.catalog.database.base`), and the steward
  writes marked rows as the next segment, then clears the marks. A line is the complete state of a
  row, with its revision; among several lines of one row the highest revision counts. So the order
  of segments does not matter, and a line may be written twice.
- The *snapshot* is a copy of the other tables that outlive a process (`SNAPSHOT_TABLES`), and of
  the marked rows. The steward replaces it from time to time, and every backup ends with one. The
  rows of a snapshot after which no segment was written are the state of the whole catalog.
"""
