"""VPR models: the networks that `placewise train` trains, as a backbone and an aggregator.

photos (B, 3, H, W) --backbone--> maps (B, C, h, w) --aggregator--> rows (B, D) of length 1

`config` defines the architecture and imports no torch; `model` builds it; `checkpoint` reads and
writes checkpoints and the smaller model files that serve. Every backbone is a stem and numbered
stages (`backbones.StagedBackbone`), so that freezing and cropping are the same for all.
docs/place-models.md lists the backbones and aggregators.
"""
