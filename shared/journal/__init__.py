"""The journal: the state of photos, maps and models, written to the object store.

A lost catalog can be rebuilt from it (`shared.rebuild`), and it shows when a catalog is older than
its object store (`shared.journal.outbox`). It follows the transactional outbox pattern: every
transaction that changes a row of `TABLES` marks the row (`shared.catalog.database.base`), and the
steward writes marked rows to the store as the next *segment*, then clears the marks.

A line of a segment is the complete state of a row, with the row's revision. Among several lines of
one row the highest revision counts. So the order of segments does not matter, and a line may be
written twice, by two stewards or after one was killed.
"""
