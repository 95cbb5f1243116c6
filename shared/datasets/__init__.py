"""Data sets of visual place recognition: their layouts, their measures, and a generated city.

Nothing here imports torch: data sets are read and written where no network is installed.
"""
