"""Every argument of `placewise train`: one class, from which flags, YAML keys and the help come.

The predecessor's arguments (aliyassine26/gsv-cities, `src/configs/args.py`) keep their names,
meanings and defaults, `warmpup_steps` included.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator

from services.trainer.read_value import (
    read_flag,
    read_height_width,
    read_names,
    read_number_or_word,
    read_structure,
)

# fmt: off
CITIES = (
    "Bangkok", "BuenosAires", "LosAngeles", "MexicoCity", "OSL", "Rome", "Barcelona", "Chicago",
    "Madrid", "Miami", "Phoenix", "TRT", "Boston", "Lisbon", "Medellin", "Minneapolis", "PRG",
    "WashingtonDC", "Brussels", "London", "Melbourne", "Osaka", "PRS",
)
# fmt: on
SMALLEST_IMAGE = 32
"""pixels of a side: below, a residual network's last map is smaller than one position"""

Flag = Annotated[bool, BeforeValidator(read_flag)]
Names = Annotated[tuple[str, ...], BeforeValidator(read_names)]
Numbers = Annotated[tuple[int, ...], BeforeValidator(read_structure)]
HeightWidth = Annotated[tuple[int, int], BeforeValidator(read_height_width)]


def _said(group: str, default: Any, help_text: str, **limits: Any) -> Any:
    return Field(default, description=help_text, json_schema_extra={"group": group}, **limits)


DATA, MODEL, LEARNING, LOSS = "Data", "Model", "Optimisation", "Loss and miner"
EVALUATION, KEEPING, MACHINE, RUN = "Evaluation", "Checkpoints", "Machine", "Run"


class TrainingArguments(BaseModel):
    """What one training run is told. Lengths in pixels are (height, width)."""

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())

    data_root: Path | None = _said(
        DATA, None, "Folder of the training set, as `placewise datasets check` recognises it."
    )
    eval_roots: Annotated[tuple[Path, ...], BeforeValidator(read_structure)] = _said(
        DATA, (), "JSON list of folders with the evaluation sets; empty: data_root."
    )
    cities: Names = _said(
        DATA, CITIES, "The cities to learn from, in that order; left out: all in the folder."
    )
    batch_size: int = _said(DATA, 64, "Places in a batch.", ge=1)
    img_per_place: int = _said(DATA, 2, "Photos of each place in a batch.", ge=1)
    min_img_per_place: int = _said(DATA, 2, "Places with fewer photos are left out.", ge=1)
    shuffle_all: Flag = _said(
        DATA, False, "Mix the places of all cities; else batches go city by city."
    )
    random_sample_from_each_place: Flag = _said(
        DATA, True, "Draw a place's photos at random; else its first ones."
    )
    image_size: HeightWidth = _said(DATA, (320, 320), "Height and width of a photo, pixels.")
    num_workers: int = _said(DATA, 8, "Processes that read photos; 0: none of their own.", ge=0)
    show_data_stats: Flag = _said(DATA, True, "Print what the data sets hold before training.")
    augmentation: Literal["randaugment", "none"] = _said(
        DATA, "randaugment", "What photos go through before the network learns from them."
    )
    on_bad_image: Literal["skip", "error"] = _said(
        DATA, "skip", "A photo that does not decode: left out, named and counted; or an error."
    )

    backbone_arch: str = _said(MODEL, "resnet18", "Name of the backbone.")
    pretrained: Flag = _said(MODEL, True, "Begin with ImageNet weights.")
    weights: Path | None = _said(
        MODEL, None, "File with the backbone's weights; else the hub's cache."
    )
    layers_to_freeze: int = _said(MODEL, 2, "Freeze up to and with this layer; -1: none.", ge=-1)
    layers_to_crop: Numbers = _said(MODEL, (), "JSON list: 4 drops layer4, 3 also layer3.")
    agg_arch: str = _said(MODEL, "AVG", "Name of the aggregator.")
    agg_config: Annotated[dict[str, Any], BeforeValidator(read_structure)] = _said(
        MODEL, {}, "JSON dict: the aggregator's own arguments; channels and map are inferred."
    )

    lr: float = _said(LEARNING, 2e-4, "Learning rate.", gt=0)
    optimizer: Literal["adam", "adamw", "sgd"] = _said(LEARNING, "adam", "Which optimiser.")
    weight_decay: float = _said(LEARNING, 0.0, "Weight decay.", ge=0)
    momentum: float = _said(LEARNING, 0.9, "Of sgd.", ge=0, lt=1)
    warmpup_steps: int = _said(
        LEARNING, 600, "Steps in which the learning rate rises linearly; also --warmup_steps.", ge=0
    )
    milestones: Numbers = _said(
        LEARNING, (5, 10, 15, 25), "JSON list of epochs at which lr is multiplied by lr_mult."
    )
    lr_mult: float = _said(LEARNING, 0.3, "The factor of each milestone.", gt=0)
    max_epochs: int = _said(LEARNING, 1, "Epochs to learn.", ge=1)
    max_steps: int | None = _said(
        LEARNING, None, "End after so many steps, also within an epoch.", ge=1
    )
    seed: int = _said(LEARNING, 1, "Of weights, sampling and augmentation.", ge=0)

    loss_name: str = _said(LOSS, "MultiSimilarityLoss", "Name of the loss.")
    miner_name: str = _said(LOSS, "MultiSimilarityMiner", "Name of the miner, or none.")
    miner_margin: float = _said(
        LOSS, 0.1, "Margin of TripletMarginMiner, epsilon of MultiSimilarityMiner."
    )

    val_set_names: Names = _said(
        EVALUATION, ("sfxs_val",), "Sets measured while learning; left out: the folder's own."
    )
    test_set_names: Names = _said(
        EVALUATION,
        ("sfxs_test", "tokyoxs_test"),
        "Sets measured by the phases test and all; left out: the folder's own.",
    )
    test_image_size: Annotated[
        Literal["same", "native"] | HeightWidth, BeforeValidator(read_height_width)
    ] = Field(
        "same",
        description="same as image_size, native (one photo at a time), or H W in pixels.",
        json_schema_extra={"group": EVALUATION},
    )
    faiss_gpu: Flag = _said(EVALUATION, True, "Search by faiss on the GPU.")
    check_val_every_n_epoch: int = _said(EVALUATION, 1, "Epochs between validations.", ge=1)
    num_sanity_val_steps: int = _said(
        EVALUATION, 0, "Validation batches tried before training; -1: all.", ge=-1
    )

    experiment_phase: Literal["train", "test", "all"] = _said(
        RUN, "train", "train, test (a checkpoint), or all: train, then test the best."
    )
    model_path: Path | None = _said(
        RUN, None, "Checkpoint that the phase test measures, and that training begins with."
    )
    default_root_dir: str = _said(RUN, "./LOGS/", "Folder of the runs.")
    run_name: str | None = _said(RUN, None, "Folder of this run below it; left out: by time.")
    logger: Names = _said(
        RUN, ("tensorboard", "csv"), "csv, tensorboard, wandb, mlflow (a list), or none."
    )
    log_every_n_steps: int = _said(RUN, 20, "Steps between two lines of the logs.", ge=1)
    fast_dev_run: Flag = _said(RUN, False, "Try one batch of everything; keep nothing.")

    monitor: str = _said(
        KEEPING, "sfxs_val/R1", "The metric that decides which checkpoints are best."
    )
    mode: Literal["min", "max"] = _said(KEEPING, "max", "Whether more of it is better.")
    save_top_k: int = _said(KEEPING, 3, "How many best checkpoints stay; -1: all, 0: none.", ge=-1)
    save_weights_only: Flag = _said(
        KEEPING, True, "Best checkpoints without the optimiser; last.ckpt always has all."
    )
    filename: str = _said(
        KEEPING,
        "{backbone_arch}_epoch({epoch:02d})_step({step:04d})_R1[{R1:.4f}]_R5[{R5:.4f}]",
        "Name of a best checkpoint; R1 is the monitored set's, others by SET/R1.",
    )
    auto_insert_metric_name: Flag = _said(
        KEEPING, False, "Write a metric's name before its figure."
    )

    accelerator: Literal["gpu", "cuda", "mps", "cpu", "auto"] = _said(
        MACHINE, "gpu", "What computes."
    )
    devices: Annotated[int | str | tuple[int, ...], BeforeValidator(read_number_or_word)] = Field(
        (0,), description="Which one: [0], or 1 for any.", json_schema_extra={"group": MACHINE}
    )
    precision: Annotated[int | str, BeforeValidator(read_number_or_word)] = Field(
        32, description="32, 16-mixed or bf16-mixed.", json_schema_extra={"group": MACHINE}
    )
    reload_dataloaders_every_n_epochs: int = _said(
        DATA, 1, "Epochs between two shufflings of the places; 0: shuffled once.", ge=0
    )

    @field_validator("image_size")
    @classmethod
    def _large_enough(cls, size: tuple[int, int]) -> tuple[int, int]:
        if min(size) < SMALLEST_IMAGE:
            raise ValueError(f"each side must be {SMALLEST_IMAGE} pixels or more")
        return size

    @field_validator("filename", "default_root_dir")
    @classmethod
    def _shell_escapes_away(cls, text: str) -> str:
        # The predecessor's command writes `\_` inside double quotes, where a shell keeps both.
        return text.replace("\\_", "_")

    @field_validator("model_path", "weights", "run_name", mode="before")
    @classmethod
    def _empty_is_none(cls, value: Any) -> Any:
        return None if value == "" else value

    @field_validator("logger")
    @classmethod
    def _known_loggers(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = ("csv", "tensorboard", "wandb", "mlflow", "none")
        for name in names:
            if name not in known:
                raise ValueError(f"{name!r} is unknown; known: {', '.join(known)}")
        if "none" in names and len(names) > 1:
            raise ValueError("none can't stand beside another logger")
        return tuple(name for name in names if name != "none")


def group_of(name: str) -> str:
    """The heading of the help under which an argument stands."""
    extra = TrainingArguments.model_fields[name].json_schema_extra
    assert isinstance(extra, dict)
    return str(extra["group"])


def is_flag(name: str) -> bool:
    """Whether the argument is true or false."""
    return TrainingArguments.model_fields[name].annotation is bool
