"""Backbones: pixels to dense local features. One module per backbone behind one small class."""

from shared.vision.backbones.base import Backbone

__all__ = ["Backbone"]
