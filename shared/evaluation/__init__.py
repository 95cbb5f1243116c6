"""Evaluation of place recognition in a map.

`places` estimates where a query was taken, from a ranking; `calibration` measures how good its
probabilities are; `bootstrap` gives intervals of shares.
"""
