"""The journal: what the catalog knows of photos and maps, written beside the objects.

It lets a lost catalog be rebuilt (`shared.rebuild`) and shows when a catalog is older than its
object store (`shared.journal.outbox`). It is an outbox: every transaction that changes a row of
`TABLES` marks it (`shared.catalog.base`), and the steward writes marked rows as the next
*segment* into the store, then clears the marks (`shared.journal.outbox`).

A line of a segment is the whole state of a row, with the row's revision. Of several lines of one
row the highest revision counts, so the order of segments does not matter, and a segment may be
there twice: two stewards, or one that was killed half way, do no harm.
"""
