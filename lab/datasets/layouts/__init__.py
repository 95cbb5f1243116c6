"""Dataset layouts: how datasets are stored on disk.

Each is an `EvaluationLayout` or a `TrainingLayout` (`base`): it recognises its folders, and reads
them into the types of `lab/datasets/dataset.py`. `open_dataset` lists them.
"""
