"""What a photo goes through before the network learns from it."""

from __future__ import annotations

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torchvision import transforms as tv

RANDAUGMENT_OPERATIONS = 3
RANDAUGMENT_MAGNITUDE = 9
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

_randaugment = tv.RandAugment(
    num_ops=RANDAUGMENT_OPERATIONS,
    magnitude=RANDAUGMENT_MAGNITUDE,
    interpolation=tv.InterpolationMode.BILINEAR,
)


def apply_randaugment(image: Image.Image, seed: int) -> Image.Image:
    """Three operations of RandAugment (Cubuk et al. 2020), the same for the same seed."""
    # RandAugment draws from the global generator, which is the training's own elsewhere.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        changed: Image.Image = _randaugment(image)
    return changed


def to_tensor(image: Image.Image) -> Tensor:
    """RGB -> (3, H, W) float32, normalised by ImageNet's means and deviations."""
    pixels = torch.from_numpy(np.array(image, np.uint8)).permute(2, 0, 1)
    mean = torch.tensor(IMAGENET_MEAN)[:, None, None]
    deviation = torch.tensor(IMAGENET_STD)[:, None, None]
    return (pixels.float() / 255 - mean) / deviation
