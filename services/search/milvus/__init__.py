"""Search on Milvus: rows are copied to a collection for each generation, and candidates asked for.

`collections` speaks to Milvus, `expressions` translates photo filters, `index` keeps a collection
in step with the catalog and answers queries.
"""
