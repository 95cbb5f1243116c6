"""The network, its loss and its steps, as Lightning drives them."""

from __future__ import annotations

from typing import Any

import lightning
import torch
from torch import Tensor

from services.trainer.arguments import TrainingArguments
from services.trainer.batches import Batch
from services.trainer.losses import make_loss
from services.trainer.miners import batch_accuracy, make_miner
from services.trainer.optimise import learning_rate, make_optimizer
from shared.errors import Unprocessable
from shared.vision.place_models.model import VprModel


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
