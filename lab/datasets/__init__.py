"""Datasets of visual place recognition: layouts on disk, ground truth, and checks.

Nothing here imports torch.
"""
