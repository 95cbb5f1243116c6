"""Codes of descriptor rows, from which search tells most rows apart from the best ones.

    rotation.py   the random rotation before any code (hadamard.py: its core)
    signs.py      a bit for each rotated number
    int8.py       a byte for each, and how far off it is at most
    stored.py     the files of codes

Loops are compiled (compiled.py), which takes a while the first time: nothing here is imported
before codes are needed.
"""
