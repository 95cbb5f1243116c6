"""Arguments of `placewise train`: definition, validation, and YAML input and output.

`TrainingArguments` is the single definition. pydantic parses and validates what flags and YAML
files say; the flags and their help are generated from the model. Arguments keep their name, meaning
and default of aliyassine26/gsv-cities (`src/configs/args.py`), also the misspelt `warmpup_steps`.

Lists and dicts are JSON. The published GSV-Cities commands write some of them in Python notation,
`(320, 320)` and `['sfxs_val']`, so both notations are accepted. An unknown key is an error that
suggests the closest known key.
"""

from __future__ import annotations

import ast
import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from shared.errors import InvalidRequest, Misconfigured, NotFound, PlacewiseError


def _parse_literal(value: Any) -> Any:
    """Parse text in JSON or Python notation; other text and other values are returned unchanged."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    for parse in (json.loads, ast.literal_eval):
        try:
            return parse(text)
        except (ValueError, SyntaxError):
            continue
    return text


def _parse_names(value: Any) -> Any:
    """Parse a list of names: a literal, a word, or words separated by commas."""
    if isinstance(value, str) and not value.lstrip().startswith(("[", "(")):
        return [name.strip() for name in value.split(",")]
    return _parse_literal(value)


def _parse_integers(value: Any) -> Any:
    """Parse a list of integers: a literal, one integer, or integers separated by commas."""
    parsed = _parse_literal(value)
    return (parsed,) if isinstance(parsed, int) and not isinstance(parsed, bool) else parsed


def _parse_image_size(value: Any) -> Any:
    """Parse `(320, 320)`, `[320, 320]`, `320 320`, `320x320` or `320` as (height, width)."""
    parsed = _parse_literal(value)
    if isinstance(parsed, str) and re.fullmatch(r"\d+\s*[x ]\s*\d+", parsed):
        parsed = re.findall(r"\d+", parsed)
    return (parsed, parsed) if isinstance(parsed, int) else parsed


# fmt: off
CITIES = (
    "Bangkok", "BuenosAires", "LosAngeles", "MexicoCity", "OSL", "Rome", "Barcelona", "Chicago",
    "Madrid", "Miami", "Phoenix", "TRT", "Boston", "Lisbon", "Medellin", "Minneapolis", "PRG",
    "WashingtonDC", "Brussels", "London", "Melbourne", "Osaka", "PRS",
)
# fmt: on
MIN_IMAGE_PIXELS = 32
"""Minimum side in pixels; below it a ResNet's last feature map is smaller than one position."""

NameList = Annotated[tuple[str, ...], BeforeValidator(_parse_names)]
IntList = Annotated[tuple[int, ...], BeforeValidator(_parse_integers)]
HeightWidth = Annotated[tuple[int, int], BeforeValidator(_parse_image_size)]

FIRST_OF_GROUP = {
    "data_root": "Data",
    "backbone_arch": "Model",
    "lr": "Optimisation",
    "loss_name": "Loss and miner",
    "val_set_names": "Evaluation",
    "experiment_phase": "Run",
    "monitor": "Checkpoints",
    "accelerator": "Machine",
}
"""Help panel of an argument and of those that follow it in `TrainingArguments`"""


class TrainingArguments(BaseModel):
    """Validated arguments of one training run. Sizes in pixels are (height, width)."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, protected_namespaces=(), use_attribute_docstrings=True
    )

    data_root: Path | None = None
    """Folder of the training set, in a layout that `placewise datasets check` knows."""
    eval_roots: Annotated[tuple[Path, ...], BeforeValidator(_parse_literal)] = ()
    """JSON list of folders with the evaluation sets. Empty: data_root."""
    cities: NameList = CITIES
    """Cities to train on, in this order. If omitted: all cities in the folder."""
    batch_size: int = Field(64, ge=1)
    """Number of places per batch."""
    img_per_place: int = Field(2, ge=1)
    """Number of photos per place in a batch."""
    min_img_per_place: int = Field(2, ge=1)
    """Skip places with fewer photos than this."""
    shuffle_all: bool = False
    """Shuffle places across cities. False: shuffle within each city, in turn."""
    random_sample_from_each_place: bool = True
    """Sample a place's photos at random. False: take its first photos."""
    image_size: HeightWidth = (320, 320)
    """Height and width of training photos, in pixels."""
    interpolation: Literal["bilinear", "bicubic"] = "bilinear"
    """Resizing of photos, which the trained model keeps: bilinear or bicubic."""
    num_workers: int = Field(8, ge=0)
    """Number of data loader processes. 0: load in the main process."""
    show_data_stats: bool = True
    """Print data set statistics before training."""
    augmentation: Literal["randaugment", "none"] = "randaugment"
    """Data augmentation of training photos: randaugment or none."""
    randaugment_magnitude: int = Field(9, ge=0, le=30)
    """Strength of randaugment's three operations, from 0 to 30."""
    on_bad_image: Literal["skip", "error"] = "skip"
    """Photos that cannot be decoded: skip (and report them) or error."""
    reload_dataloaders_every_n_epochs: int = Field(1, ge=0)
    """Reshuffle the places every n epochs. 0: shuffle once."""

    backbone_arch: str = "resnet18"
    """Name of the backbone, or package.module:function of your own."""
    pretrained: bool = True
    """Initialise the backbone with ImageNet weights."""
    weights: Path | None = None
    """File with the backbone's weights, or a checkpoint of the whole network to fine-tune. If
    omitted: the torch.hub cache."""
    layers_to_freeze: int = Field(2, ge=-1)
    """Freeze layers up to and including this one. -1: freeze none."""
    layers_to_crop: IntList = ()
    """JSON list of layers to remove: 4 removes layer4, 3 also removes layer3."""
    backbone_norm: bool = True
    """Apply the final norm of DINOv2 and Swin. False for BoQ's published DINOv2."""
    agg_arch: str = "AVG"
    """Name of the aggregator, or package.module:Class of your own."""
    agg_config: Annotated[dict[str, Any], BeforeValidator(_parse_literal)] = {}
    """JSON dict of aggregator arguments. Channels and map size are inferred."""

    lr: float = Field(2e-4, gt=0)
    """Learning rate."""
    optimizer: Literal["adam", "adamw", "sgd"] = "adam"
    """Optimizer: adam, adamw or sgd."""
    weight_decay: float = Field(0.0, ge=0)
    """Weight decay."""
    momentum: float = Field(0.9, ge=0, lt=1)
    """Momentum of the sgd optimizer."""
    warmpup_steps: int = Field(600, ge=0)
    """Number of linear learning-rate warm-up steps. Alias: --warmup_steps."""
    milestones: IntList = (5, 10, 15, 25)
    """JSON list of epochs at which lr is multiplied by lr_mult."""
    lr_mult: float = Field(0.3, gt=0)
    """Learning-rate factor per milestone."""
    max_epochs: int = Field(1, ge=1)
    """Number of epochs."""
    max_steps: int | None = Field(None, ge=1)
    """Maximum number of steps; training may end within an epoch."""
    seed: int = Field(1, ge=0, lt=2**32)
    """Random seed of weights, sampling and augmentation."""

    loss_name: str = "MultiSimilarityLoss"
    """Name of the loss, or package.module:Class of your own."""
    miner_name: str = "MultiSimilarityMiner"
    """Name of the miner, package.module:Class, or none."""
    miner_margin: float = 0.1
    """Margin of TripletMarginMiner, epsilon of MultiSimilarityMiner."""

    val_set_names: NameList = ("sfxs_val",)
    """Validation sets. If omitted: those found in the folder."""
    test_set_names: NameList = ("sfxs_test", "tokyoxs_test")
    """Test sets of the phases test and all. If omitted: those found in the folder."""
    val_image_size: HeightWidth | None = None
    """Height and width of validation photos, which the trained model keeps. If omitted:
    image_size."""
    test_image_size: Annotated[
        Literal["same", "native"] | HeightWidth, BeforeValidator(_parse_image_size)
    ] = "same"
    """Test photo size: same as in validation, native (batches of one), or H W pixels."""
    faiss_gpu: bool = True
    """Run the faiss search on the GPU."""
    check_val_every_n_epoch: int = Field(1, ge=1)
    """Validate every n epochs, and after the last."""
    save_val_predictions: bool = False
    """Save the predictions of each validation. Those of tests always are."""
    num_sanity_val_steps: int = Field(0, ge=-1)
    """Number of validation batches run before training. -1: all."""

    experiment_phase: Literal["train", "test", "all"] = "train"
    """train, test (a checkpoint), or all: train, then test the best checkpoint."""
    model_path: Path | None = None
    """Checkpoint to test (phase test) or to initialise training from."""
    default_root_dir: str = "./LOGS/"
    """Root folder of the runs."""
    compatible: bool = False
    """Train and test as the GSV-Cities script did where an argument means something else here: adam
    is AdamW, no layer is frozen, tests at native size, warm-up before milestones."""
    run_name: str | None = None
    """Folder name of this run. If omitted: a timestamp and the model's name."""
    logger: Annotated[
        tuple[Literal["csv", "tensorboard", "wandb", "mlflow", "none"], ...],
        BeforeValidator(_parse_names),
    ] = ("tensorboard", "csv")
    """List of csv, tensorboard, wandb and mlflow, or none."""
    log_every_n_steps: int = Field(20, ge=1)
    """Number of steps between log entries."""
    fast_dev_run: bool = False
    """Run one batch of training and validation as a check; write no files."""

    monitor: str = "sfxs_val/R1"
    """Metric by which the best checkpoints are chosen."""
    mode: Literal["min", "max"] = "max"
    """Direction of the monitored metric: max or min."""
    save_top_k: int = Field(3, ge=-1)
    """Number of best checkpoints to keep. -1: all, 0: none."""
    save_weights_only: bool = True
    """Save best checkpoints without optimizer state; last.ckpt has it always."""
    filename: str = "{backbone_arch}_epoch({epoch:02d})_step({step:04d})_R1[{R1:.4f}]_R5[{R5:.4f}]"
    """Name template of the best checkpoints. R1 is the monitored set's; SET/R1 names others."""
    auto_insert_metric_name: bool = False
    """Insert each metric's name before its value in the file name."""

    accelerator: Literal["gpu", "cuda", "mps", "cpu", "auto"] = "auto"
    """Training accelerator: gpu, cuda, mps, cpu or auto."""
    devices: Annotated[int | str | tuple[int, ...], BeforeValidator(_parse_literal)] = (0,)
    """Device to train on: its index as [0], or 1 for any."""
    precision: Annotated[int | str, BeforeValidator(_parse_literal)] = 32
    """Floating-point precision: 32 (on a GPU with TF32), 32-true, 16-mixed or bf16-mixed."""
    compile: bool = False
    """Compile the network with torch.compile. Sums may differ in last digits."""

    @property
    def evaluation_size(self) -> tuple[int, int]:
        """Height and width of validation photos, and of the photos that the trained model takes."""
        return self.val_image_size or self.image_size

    @field_validator("image_size", "val_image_size")
    @classmethod
    def _check_image_size(cls, size: tuple[int, int] | None) -> tuple[int, int] | None:
        if size is not None and min(size) < MIN_IMAGE_PIXELS:
            raise ValueError(f"height and width must be {MIN_IMAGE_PIXELS} pixels or more")
        return size

    @field_validator("filename", "default_root_dir")
    @classmethod
    def _unescape_underscores(cls, text: str) -> str:
        # The published GSV-Cities command writes `\_` in double quotes; a shell keeps the backslash
        return text.replace("\\_", "_")

    @field_validator("model_path", "weights", "run_name", mode="before")
    @classmethod
    def _empty_is_none(cls, value: Any) -> Any:
        return None if value == "" else value

    @field_validator("logger")
    @classmethod
    def _check_loggers(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if "none" in names and len(names) > 1:
            raise ValueError("none cannot be combined with other loggers")
        return tuple(name for name in names if name != "none")


def argument_groups() -> dict[str, str]:
    """Return the help panel of each argument."""
    groups, group = {}, ""
    for name in TrainingArguments.model_fields:
        group = groups[name] = FIRST_OF_GROUP.get(name, group)
    return groups


ALIASES = {"warmup_steps": "warmpup_steps"}
"""Correct spelling -> the name in the GSV-Cities code"""


def normalise_name(name: str) -> str:
    """Replace hyphens by underscores, and an alias by the argument's name."""
    name = name.replace("-", "_")
    return ALIASES.get(name, name)


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Return ` Did you mean ...?` with the closest known name, else a list of all known names."""
    names = list(known)
    by_lower = {each.lower(): each for each in names}
    matches = difflib.get_close_matches(name.lower(), by_lower, n=1)
    if matches:
        return f" Did you mean {by_lower[matches[0]]}?"
    return f" Known: {', '.join(names)}."


def combine_obstacles(obstacles: Sequence[PlacewiseError]) -> PlacewiseError:
    """Return the only obstacle, or an error `several_obstacles` that lists all."""
    if len(obstacles) == 1:
        return obstacles[0]
    lines = [f"- {error.code}: {error.detail}" for error in obstacles]
    return Misconfigured("several_obstacles", "\n".join(["The run can't start:", *lines]))


def no_gpu_error(reason: str) -> Misconfigured:
    """Build the error of a run on a GPU that can't be used."""
    return Misconfigured(
        "no_gpu",
        f"{reason}. Train on what the machine has with --accelerator auto, the default, or install "
        "the driver and a CUDA build of PyTorch.",
    )


def data_root_error() -> InvalidRequest:
    """Build the error of a run without --data-root."""
    return InvalidRequest(
        "data_root_missing",
        "--data-root DIR is required: the folder of the data set, in a layout that `placewise "
        "datasets check DIR` recognises. `placewise datasets synth DIR` generates a data set "
        "for a first try.",
    )


def load_yaml(path: Path) -> dict[str, Any]:
    """Load arguments from a YAML file, keyed by canonical name.

    Raises:
        NotFound: `config_not_found`.
        InvalidRequest: `bad_config` if the file is not a mapping, `unknown_argument` for a key.
    """
    return resolve_keys(load_mapping(path), str(path))


def load_mapping(path: Path) -> dict[str, Any]:
    """Load a mapping with any string keys from a YAML file.

    Raises:
        NotFound: `config_not_found`.
        InvalidRequest: `bad_config` if the file is not a mapping.
    """
    import yaml  # part of the extra `lab`; `--help` must work without it

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise NotFound("config_not_found", f"Can't read {path}: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidRequest("bad_config", f"{path} is not valid YAML: {error}") from error
    if loaded is None:
        return {}
    if not isinstance(loaded, dict) or not all(isinstance(key, str) for key in loaded):
        raise InvalidRequest(
            "bad_config", f"{path} must be a mapping of names to values, such as `lr: 0.0002`."
        )
    return loaded


def resolve_keys(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Replace each key with the argument's canonical name.

    Raises InvalidRequest: `unknown_argument`; the message begins with `source`.
    """
    resolved = {normalise_name(key): value for key, value in values.items()}
    unknown = [name for name in resolved if name not in TrainingArguments.model_fields]
    if unknown:
        suggestion = suggest_name(unknown[0], TrainingArguments.model_fields)
        raise InvalidRequest(
            "unknown_argument", f"{source}: Unknown argument {unknown[0]!r}.{suggestion}"
        )
    return resolved


# Added to pydantic's messages, by the type of its error.
EXPECTED_VALUES = {
    "bool_parsing": ". Expected True or False",
    "tuple_type": """. Expected a JSON list, such as [4] or ["a", "b"]""",
    "dict_type": """. Expected a JSON dict, such as {"p": 3}""",
}


def build_arguments(*layers: Mapping[str, Any]) -> TrainingArguments:
    """Merge and validate arguments; later layers override earlier ones.

    Raises InvalidRequest: `bad_argument`; the message names each invalid argument and its value.
    """
    merged = {name: value for layer in layers for name, value in layer.items()}
    try:
        return _apply_compatibility(TrainingArguments(**merged))
    except ValidationError as error:
        messages = [
            f"--{detail['loc'][0]}: {detail['msg'].removeprefix('Value error, ')}"
            f"{EXPECTED_VALUES.get(detail['type'], '')} (got {detail['input']!r})"
            for detail in error.errors()
        ]
        raise InvalidRequest("bad_argument", "; ".join(dict.fromkeys(messages))) from error


def _apply_compatibility(arguments: TrainingArguments) -> TrainingArguments:
    """Under `compatible`, replace the values that had another effect in the GSV-Cities script."""
    if not arguments.compatible:
        return arguments
    changes: dict[str, Any] = {"layers_to_freeze": -1}
    if arguments.optimizer == "adam":
        changes["optimizer"] = "adamw"
    if "test_image_size" not in arguments.model_fields_set:
        changes["test_image_size"] = "native"
    return arguments.model_copy(update=changes)


def to_plain_dict(arguments: TrainingArguments) -> dict[str, Any]:
    """Return every argument as JSON-compatible values."""
    plain: dict[str, Any] = arguments.model_dump(mode="json")
    return plain


def save_yaml(arguments: TrainingArguments, path: Path) -> None:
    """Write every argument to a YAML file that `--config` accepts, to reproduce the run.

    A run that is killed meanwhile keeps the file that it had.
    """
    import yaml

    text = yaml.safe_dump(to_plain_dict(arguments), sort_keys=False, allow_unicode=True)
    partial = path.with_name(f"{path.name}.partial")
    partial.write_text("# Every argument of this run: placewise train --config THIS\n" + text)
    partial.replace(path)
