"""From ranked photos to a place: where it is, whether it is in the map at all, how sure that is.

`places` says when two photos show one place, `evidence` what a ranking tells, `calibration` what
a generation's evaluations have learnt of such evidence, `figures` how good the confidence is.
"""
