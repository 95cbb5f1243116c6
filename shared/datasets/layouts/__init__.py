"""How data sets lie on disk: one module for each way; `registry.py` lists them.

Each is a `TrainingLayout` or an `EvaluationLayout` (`layout.py`): it tells its folders from others,
and reads them into the types of `shared/datasets/shots.py`.
"""
