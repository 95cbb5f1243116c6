"""Evaluation on data sets: rankings, recall, retrieval metrics, sequences, reports.

    describe -> descriptors -> exact_knn -> ranking (recall@k; training validates with it)
                                         -> retrieval_metrics -> results, report

Descriptors come from a `DescribeFunction`: a checkpoint's network in training, any extractor in the
command line. All are therefore measured by the same code.
"""
