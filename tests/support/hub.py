"""Folders as torch.hub knows them: a `hubconf.py` whose entries make small networks."""

from __future__ import annotations

from pathlib import Path

COMMIT = "0123456789abcdef0123456789abcdef01234567"

# The global descriptor is a fixed projection of a photo made small: photos are as near as their
# colours are. Other entries are what a repository must not be.
HUBCONF = '''
dependencies = ["torch"]
import torch
from networks import Colours


def colours(dimension=24, scale=1.0):
    """A descriptor of the photo's colours."""
    return Colours(dimension, scale)


def with_attention(dimension=24):
    """As BoQ: the descriptor, then another output."""

    class Both(Colours):
        def forward(self, batch):
            return super().forward(batch), [batch]

    return Both(dimension)


def one_size(side=320):
    class OneSize(Colours):
        def forward(self, batch):
            assert batch.shape[2:] == (side, side), f"only {side} x {side} will do"
            return super().forward(batch)

    return OneSize()


def maps():
    return torch.nn.Conv2d(3, 4, 1)


def not_finite():
    class NotFinite(Colours):
        def forward(self, batch):
            return super().forward(batch) / 0.0 - super().forward(batch) / 0.0

    return NotFinite()


def zero():
    return Colours(scale=0.0)


def of_the_batch():
    class OfTheBatch(Colours):
        def forward(self, batch):
            found = super().forward(batch)
            return found - 0.9 * found.mean(dim=0) if len(batch) > 1 else found

    return OfTheBatch()


def asks():
    input("Do you trust this repository (y/N)?")


def prints():
    print("printed by the code of others")
    return Colours()


def from_network(url="http://127.0.0.1:9/weights.pth", check_hash=False):
    net = Colours()
    net.load_state_dict(torch.hub.load_state_dict_from_url(url, check_hash=check_hash))
    return net


def a_number():
    return 3


def fails():
    raise KeyError("no such backbone")
'''
NETWORKS = """
import torch


class Colours(torch.nn.Module):
    def __init__(self, dimension=24, scale=1.0):
        super().__init__()
        projection = torch.randn(192, dimension, generator=torch.Generator().manual_seed(7))
        self.projection = torch.nn.Parameter(scale * projection)

    def forward(self, batch):
        small = torch.nn.functional.adaptive_avg_pool2d(batch, 8)
        return small.flatten(1) @ self.projection
"""
MIT = "MIT License\n\nCopyright (c) somebody\n"


def write_hub(folder: Path, *, licence: str | None = MIT) -> Path:
    """A folder with the entries above."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "hubconf.py").write_text(HUBCONF)
    (folder / "networks.py").write_text(NETWORKS)
    if licence is not None:
        (folder / "LICENSE").write_text(licence)
    return folder
