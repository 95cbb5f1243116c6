"""Image descriptors: photo bytes to global descriptors. The only PyTorch code in `shared`.

bytes --decode, preprocessing--> RGB pixels --backbone--> dense local features --aggregator--> row

Decoding and preprocessing live in `shared.imaging`, which does not import torch, because they run
in the decoding child processes.
"""
