"""Evaluation of place recognition in a map: location estimates, calibration, bootstrap intervals.

Estimates of a query's place: `places.evidence` decides when two photos show the same place and how
strongly a ranking supports a place; `calibration` turns this evidence into an accept threshold and
a confidence, and measures how good the confidence is.
"""
