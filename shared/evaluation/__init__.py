"""Evaluation of place recognition: location estimates, calibration, retrieval metrics, reports.

Estimates of a query's place: `places.evidence` decides when two photos show the same place and how
strongly a ranking supports a place; `calibration` turns this evidence into an accept threshold and
a confidence, and measures how good the confidence is.

Evaluation on data sets:

    describe -> descriptors -> exact_knn -> ranking (recall@k; training validates with it)
                                         -> retrieval_metrics -> results, report

Descriptors come from a `DescribeFunction`: a checkpoint's network in the trainer, any extractor in
the command line. All are therefore measured by the same code.
"""
