"""Does the object store hold what the catalog says, and is it what was written?"""
