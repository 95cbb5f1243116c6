"""Lightning module of metric-learning training; its optimizer, learning rate and model factory.

The learning rate is a function of step and epoch alone. It is set before each step instead of by a
torch scheduler, so that a resumed run needs no scheduler state and milestones inside the warm-up
count.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import lightning
import torch
from torch import Tensor

from services.trainer.arguments import TrainingArguments
from services.trainer.data import Batch
from services.trainer.losses import make_loss
from services.trainer.miners import batch_accuracy, make_miner
from services.trainer.run_control import Display
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.config import VprModelConfig
from shared.descriptors.vpr_models.model import VprModel, build_vpr_model
from shared.errors import Conflict, Unprocessable


def make_optimizer(
    parameters: Iterable[torch.nn.Parameter], arguments: TrainingArguments
) -> torch.optim.Optimizer:
    """Create Adam, AdamW or SGD over the trainable parameters."""
    trainable = [parameter for parameter in parameters if parameter.requires_grad]
    lr, decay = arguments.lr, arguments.weight_decay
    if arguments.optimizer == "sgd":
        return torch.optim.SGD(trainable, lr, arguments.momentum, weight_decay=decay)
    if arguments.optimizer == "adamw":
        return torch.optim.AdamW(trainable, lr, weight_decay=decay)
    return torch.optim.Adam(trainable, lr, weight_decay=decay)


def learning_rate(
    step: int,
    epoch: int,
    *,
    lr: float,
    warmup_steps: int,
    milestones: Sequence[int],
    lr_mult: float,
) -> float:
    """Return the learning rate of a step: linear warm-up times step decay.

    Args:
        step: global step, from 0.
        epoch: epoch, from 0.
        lr: base learning rate.
        warmup_steps: steps over which the rate rises linearly; 0: no warm-up.
        milestones: epochs from which on the rate is multiplied by `lr_mult`.
        lr_mult: factor of each milestone.
    """
    warmup = min(1.0, (step + 1) / warmup_steps) if warmup_steps else 1.0
    milestones_passed = sum(epoch >= milestone for milestone in milestones)
    return lr * warmup * float(lr_mult**milestones_passed)


class MetricLearningModule(lightning.LightningModule):
    """Lightning module: photos -> descriptors -> mined pairs or triplets -> loss.

    Args:
        model: the descriptor network.
        arguments: loss, miner, optimizer and learning rate.
        metadata: plain values that checkpoints store with the model's configuration.

    Attributes:
        last_loss: loss of the last step.
        last_accuracy: `b_acc` of the last step; None where it is not meaningful.
    """

    def __init__(
        self, model: VprModel, arguments: TrainingArguments, metadata: dict[str, Any]
    ) -> None:
        super().__init__()
        self.model = model
        self.loss = make_loss(arguments.loss_name)
        self.miner = make_miner(arguments.miner_name, arguments.miner_margin)
        self.last_loss = float("nan")
        self.last_accuracy: float | None = None
        self._arguments = arguments
        self._metadata = metadata

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return make_optimizer(self.model.parameters(), self._arguments)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        rate = learning_rate(
            self.global_step,
            self.current_epoch,
            lr=self._arguments.lr,
            warmup_steps=self._arguments.warmpup_steps,
            milestones=self._arguments.milestones,
            lr_mult=self._arguments.lr_mult,
        )
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = rate
        self.log("lr", rate, batch_size=1)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        if not len(batch.photos):
            raise Unprocessable(
                "no_photo_decodes",
                "None of a batch's photos can be decoded: "
                + "; ".join(p for p, _ in batch.undecodable[:3]),
            )
        rows = self.model(batch.photos)
        # Losses exponentiate similarities, which overflows in half precision.
        with torch.autocast(rows.device.type, enabled=False):
            rows = rows.float()
            mined = self.miner(rows, batch.labels) if self.miner is not None else None
            loss: Tensor = self.loss(rows, batch.labels, mined)
        self.last_loss = float(loss.detach())
        if not torch.isfinite(loss):
            raise Unprocessable(
                "loss_not_finite",
                f"The loss of step {self.global_step} is {self.last_loss}: training has diverged. "
                "Try a smaller --lr, more --warmpup_steps or --precision 32.",
            )
        self.last_accuracy = batch_accuracy(self.loss, self.miner, mined, len(rows))
        self.log("loss", loss.detach(), batch_size=len(rows))
        if self.last_accuracy is not None:
            self.log("b_acc", self.last_accuracy, batch_size=len(rows))
        return loss

    def transfer_batch_to_device(
        self, batch: Batch, device: torch.device, dataloader_idx: int
    ) -> Batch:
        return batch.to(device, non_blocking=True)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        config = self.model.config.model_dump()
        checkpoint["hyper_parameters"] = {**self._metadata, "model": config}
        checkpoint["last_loss"] = self.last_loss
        checkpoint["epoch_done"] = self.trainer.is_last_batch


def build_model_config(arguments: TrainingArguments) -> VprModelConfig:
    """Build the model configuration from the arguments; raises what `VprModelConfig.parse` does."""
    return VprModelConfig.parse(
        {name: getattr(arguments, name) for name in VprModelConfig.model_fields}
    )


def make_model(arguments: TrainingArguments, display: Display, *, resuming: bool) -> VprModel:
    """Create the network with pretrained weights, those of `model_path`, or random weights.

    Args:
        arguments: the run's arguments; random weights depend on the global seed.
        display: receives a warning if frozen layers have random weights.
        resuming: the weights are loaded later, from the run's checkpoint.

    Raises:
        Conflict: `run_differs`, if the checkpoint's network differs from the arguments'. Also
            raises what `build_vpr_model` and `load_checkpoint` raise.
    """
    config = build_model_config(arguments)
    has_checkpoint = resuming or arguments.model_path is not None
    if has_checkpoint:
        model = build_vpr_model(config.model_copy(update={"pretrained": False}))
        model.config = model.config.model_copy(update={"pretrained": config.pretrained})
    else:
        model = build_vpr_model(config, weights=arguments.weights)
    if arguments.model_path is not None and not resuming:
        initial = load_checkpoint(arguments.model_path).model
        if initial.config.model_dump(exclude=_TRAINING_ONLY_FIELDS) != model.config.model_dump(
            exclude=_TRAINING_ONLY_FIELDS
        ):
            raise Conflict(
                "run_differs",
                f"The network of --model_path {arguments.model_path} differs from the one that the "
                f"arguments describe: {initial.config.model_dump_json()}",
            )
        model.load_state_dict(initial.state_dict())
    if not config.pretrained and not has_checkpoint and config.layers_to_freeze >= 0:
        display.warn(
            f"--layers_to_freeze {config.layers_to_freeze} freezes layers whose weights are random "
            "(--pretrained False): they never learn. Use --layers_to_freeze -1 to train them."
        )
    return model


_TRAINING_ONLY_FIELDS = {"pretrained", "layers_to_freeze"}
