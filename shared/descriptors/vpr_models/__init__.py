"""Networks that `placewise train` trains: a backbone, and an aggregator that makes the descriptor.

photos (B, 3, H, W) --backbone--> maps (B, C, h, w) --aggregator--> rows (B, D) of length 1

`config` says which network, and imports no torch; `model` builds it; `checkpoint` reads and writes
it, `model_file` keeps what is left of one that serves. Every backbone is a stem and numbered stages
(`backbones/staged.py`), so that freezing and cropping mean the same for all. docs/place-models.md
lists them.
"""
