"""The optimiser, and the learning rate as a function of how far the run is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

from services.trainer.arguments import TrainingArguments


def make_optimizer(
    parameters: Iterable[torch.nn.Parameter], arguments: TrainingArguments
) -> torch.optim.Optimizer:
    """Adam, AdamW or SGD over the parameters that learn."""
    learning = [parameter for parameter in parameters if parameter.requires_grad]
    lr, decay = arguments.lr, arguments.weight_decay
    if arguments.optimizer == "sgd":
        return torch.optim.SGD(learning, lr, arguments.momentum, weight_decay=decay)
    if arguments.optimizer == "adamw":
        return torch.optim.AdamW(learning, lr, weight_decay=decay)
    return torch.optim.Adam(learning, lr, weight_decay=decay)


def learning_rate(
    step: int,
    epoch: int,
    *,
    lr: float,
    warmup_steps: int,
    milestones: Sequence[int],
    lr_mult: float,
) -> float:
    """The rate of a step, both counted from 0: a linear rise over `warmup_steps`, and a factor
    `lr_mult` from each milestone's epoch on."""
    rise = min(1.0, (step + 1) / warmup_steps) if warmup_steps else 1.0
    passed = sum(epoch >= milestone for milestone in milestones)
    return lr * rise * float(lr_mult**passed)
