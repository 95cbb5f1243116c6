"""What every statement costs on a large catalog: `fill` it, make the real `calls`, `explain` each.

The statements are caught while the services' own functions run, so none can be forgotten here or
differ from what is asked in earnest.
"""
