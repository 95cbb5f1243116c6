"""Makes models of maps: which photos are compared, their matches, the reconstruction, its errors.

`pairs`, `matching`, `mapping` and `calibrate` are the steps in this order; none reads the catalog.
`evidence` and `positions` compare matches and models with the coordinates of photos.
`mapping` needs the extra `pose`, and pycolmap runs in a child process.
"""
