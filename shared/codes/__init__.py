"""Compact codes of descriptor rows, by which search rules out most rows.

    rotation.py       random rotation and fast Walsh-Hadamard transform, applied before coding
    sign_codes.py     one bit for each rotated number
    serialization.py  file format of codes
    jit.py            compilation of the loops by numba

Compilation takes a while the first time, so import these modules only when codes are needed.
"""
