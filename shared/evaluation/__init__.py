"""From ranked photos to a place: where it is, whether it is in the map at all, how sure that is.

`places` says when two photos show one place, `evidence` what a ranking tells, `calibration` what
a generation's evaluations have learnt of such evidence, `figures` how good the confidence is.

Evaluation: photos of a data set to rows, rows to rankings, rankings to figures and reports.

    describe -> rows -> nearest -> recalls        what training validates with
                                -> figures -> report, differences between runs

Photos come through a `Describe`: a checkpoint's network here, any extractor where the command line
wires it, so that the same figures are taken of everything.
"""
