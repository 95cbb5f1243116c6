"""Codes of descriptor rows, from which search tells most rows apart from the best ones.

    rotation.py   the random rotation before any code (hadamard.py: its compiled core)
    signs.py      a bit for each rotated number
    stored.py     the file that lies beside a chunk

numba compiles what is slow in Python; nothing here is imported before codes are needed.
"""
