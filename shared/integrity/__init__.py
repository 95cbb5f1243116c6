"""Integrity checks: does the object store hold what the catalog references, undamaged?"""
