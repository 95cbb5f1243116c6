"""Query plans: checks that no statement of the services scans a large table.

    DATABASE_URL=postgresql+psycopg://... placewise bench catalog [--photos 1000000]

`fill` creates the rows in a temporary database, `command` calls the services' own functions, and
`explain` captures and explains the statements that these functions send, which are therefore those
of production. Columns: the call, server time, rows read and returned, and the plan's scans. The
exit code is 1 if a statement scans a large table or reads far more rows than it returns.
"""
