"""The network, its loss and its steps, as Lightning drives them.

The optimiser, and the learning rate as a function of how far the run is.

The network that a run begins with.
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


class MetricLearningModule(lightning.LightningModule):
    """One step: photos -> descriptors -> the miner's pairs or triplets -> the loss.

    `about` are plain values that its checkpoints carry beside the model's configuration.
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
        self._about = metadata

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
                "No photo of a whole batch decodes: "
                + "; ".join(p for p, _ in batch.undecodable[:3]),
            )
        rows = self.model(batch.photos)
        # Exponents of similarities overflow in half precision.
        with torch.autocast(rows.device.type, enabled=False):
            rows = rows.float()
            mined = self.miner(rows, batch.labels) if self.miner is not None else None
            loss: Tensor = self.loss(rows, batch.labels, mined)
        self.last_loss = float(loss.detach())
        if not torch.isfinite(loss):
            raise Unprocessable(
                "loss_not_finite",
                f"The loss of step {self.global_step} is {self.last_loss}: the training has "
                "diverged. Try a smaller --lr, more --warmpup_steps or --precision 32.",
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
        model = self.model.config.model_dump()
        checkpoint["hyper_parameters"] = {**self._about, "model": model}
        checkpoint["last_loss"] = self.last_loss
        checkpoint["epoch_done"] = self.trainer.is_last_batch


def build_model_config(arguments: TrainingArguments) -> VprModelConfig:
    """The model that the arguments describe; raises what `ModelConfig.read` does."""
    return VprModelConfig.parse(
        {name: getattr(arguments, name) for name in VprModelConfig.model_fields}
    )


def make_model(arguments: TrainingArguments, display: Display, *, resuming: bool) -> VprModel:
    """With pretrained weights, with those of `model_path`, or random by the seed.

    One that resumes gets its weights later. Raises what `build_vpr_model` and `load_checkpoint`
    do, and
    Conflict (`run_differs`) for a checkpoint of another network.
    """
    config = build_model_config(arguments)
    elsewhere = resuming or arguments.model_path is not None
    if elsewhere:
        model = build_vpr_model(config.model_copy(update={"pretrained": False}))
        model.config = model.config.model_copy(update={"pretrained": config.pretrained})
    else:
        model = build_vpr_model(config, weights=arguments.weights)
    if arguments.model_path is not None and not resuming:
        begun = load_checkpoint(arguments.model_path).model
        if begun.config.model_dump(exclude=_TRAINING_ONLY_FIELDS) != model.config.model_dump(
            exclude=_TRAINING_ONLY_FIELDS
        ):
            raise Conflict(
                "run_differs",
                f"--model_path {arguments.model_path} is another network than the arguments "
                f"describe: {begun.config.model_dump_json()}",
            )
        model.load_state_dict(begun.state_dict())
    if not config.pretrained and not elsewhere and config.layers_to_freeze >= 0:
        display.warn(
            f"--layers_to_freeze {config.layers_to_freeze} freezes layers whose weights are random "
            "(--pretrained False): they never learn. Say --layers_to_freeze -1 to train them."
        )
    return model


_TRAINING_ONLY_FIELDS = {"pretrained", "layers_to_freeze"}
