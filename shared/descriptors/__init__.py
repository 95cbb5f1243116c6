"""Image descriptors: photo bytes to global descriptors.

bytes --decode, preprocessing--> RGB pixels --backbone--> dense patch features --aggregator--> row

Decoding and preprocessing live in `shared.imaging`, which does not import torch, because they run
in the decoding child processes.
"""
