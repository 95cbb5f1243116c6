"""Every argument of `placewise train`: one class, from which flags, YAML keys and the help come.

The predecessor's arguments (aliyassine26/gsv-cities, `src/configs/args.py`) keep their names,
meanings and defaults, `warmpup_steps` included.

Text of a flag or of a YAML file -> what an argument means by it.

Lists and dicts are JSON. The predecessor's published commands write some of them as Python does,
`(320, 320)` and `['sfxs_val']`, so both are read.

From flags and YAML files to checked arguments, and back to a file.

A key that is not known is an error that names the nearest known one.
"""

from __future__ import annotations

import ast
import difflib
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from shared.errors import InvalidRequest, NotFound

TRUE_WORDS = frozenset(("true", "yes", "on", "1"))
FALSE_WORDS = frozenset(("false", "no", "off", "0"))


def parse_bool(value: Any) -> Any:
    """`True`, `false`, `yes`, `0` ... -> bool; what is no text stays for pydantic to judge.

    Raises ValueError for any other text: a non-empty text is not simply true.
    """
    if not isinstance(value, str):
        return value
    word = value.strip().lower()
    if word in TRUE_WORDS:
        return True
    if word in FALSE_WORDS:
        return False
    raise ValueError(f"{value!r} is neither true nor false")


def parse_literal(value: Any) -> Any:
    """JSON or Python notation -> list, tuple, dict or number; ValueError for what is neither."""
    if not isinstance(value, str):
        return value
    text = value.strip()
    for read in (json.loads, ast.literal_eval):
        try:
            return read(text)
        except (ValueError, SyntaxError):
            continue
    raise ValueError(f"{value!r} is neither JSON nor Python notation")


def parse_names(value: Any) -> Any:
    """As `parse_literal`; a bare word, or several with commas between, is a list of names."""
    if isinstance(value, str) and re.fullmatch(r"[\w.\- ]+(,[\w.\- ]+)*", value.strip()):
        return [name.strip() for name in value.split(",")]
    return parse_literal(value)


def parse_image_size(value: Any) -> Any:
    """`(320, 320)`, `[320, 320]`, `320 320`, `320x320` (H W) and `320` (both) -> (H, W)."""
    if isinstance(value, str):
        numbers = re.fullmatch(r"\s*(\d+)(?:\s*[x, ]\s*(\d+))?\s*", value)
        if numbers:
            return (int(numbers[1]), int(numbers[2] or numbers[1]))
        value = parse_literal(value) if value.strip()[:1] in ("(", "[") else value.strip()
    if isinstance(value, int):
        return (value, value)
    return value


def parse_number_or_text(value: Any) -> Any:
    """`32` -> 32, `[0]` -> [0], `16-mixed` -> "16-mixed"."""
    if not isinstance(value, str):
        return value
    try:
        return parse_literal(value)
    except ValueError:
        return value.strip()


# fmt: off
CITIES = (
    "Bangkok", "BuenosAires", "LosAngeles", "MexicoCity", "OSL", "Rome", "Barcelona", "Chicago",
    "Madrid", "Miami", "Phoenix", "TRT", "Boston", "Lisbon", "Medellin", "Minneapolis", "PRG",
    "WashingtonDC", "Brussels", "London", "Melbourne", "Osaka", "PRS",
)
# fmt: on
MIN_IMAGE_PIXELS = 32
"""pixels of a side: below, a residual network's last map is smaller than one position"""

Bool = Annotated[bool, BeforeValidator(parse_bool)]
NameList = Annotated[tuple[str, ...], BeforeValidator(parse_names)]
IntList = Annotated[tuple[int, ...], BeforeValidator(parse_literal)]
HeightWidth = Annotated[tuple[int, int], BeforeValidator(parse_image_size)]


def _argument(group: str, default: Any, help_text: str, **limits: Any) -> Any:
    return Field(default, description=help_text, json_schema_extra={"group": group}, **limits)


DATA, MODEL, OPTIMISATION, LOSS = "Data", "Model", "Optimisation", "Loss and miner"
EVALUATION, CHECKPOINTS, MACHINE, RUN = "Evaluation", "Checkpoints", "Machine", "Run"


class TrainingArguments(BaseModel):
    """What one training run is told. Lengths in pixels are (height, width)."""

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())

    data_root: Path | None = _argument(
        DATA, None, "Folder of the training set, as `placewise datasets check` recognises it."
    )
    eval_roots: Annotated[tuple[Path, ...], BeforeValidator(parse_literal)] = _argument(
        DATA, (), "JSON list of folders with the evaluation sets; empty: data_root."
    )
    cities: NameList = _argument(
        DATA, CITIES, "The cities to learn from, in that order; left out: all in the folder."
    )
    batch_size: int = _argument(DATA, 64, "Places in a batch.", ge=1)
    img_per_place: int = _argument(DATA, 2, "Photos of each place in a batch.", ge=1)
    min_img_per_place: int = _argument(DATA, 2, "Places with fewer photos are left out.", ge=1)
    shuffle_all: Bool = _argument(
        DATA, False, "Mix the places of all cities; else batches go city by city."
    )
    random_sample_from_each_place: Bool = _argument(
        DATA, True, "Draw a place's photos at random; else its first ones."
    )
    image_size: HeightWidth = _argument(DATA, (320, 320), "Height and width of a photo, pixels.")
    num_workers: int = _argument(DATA, 8, "Processes that read photos; 0: none of their own.", ge=0)
    show_data_stats: Bool = _argument(DATA, True, "Print what the data sets hold before training.")
    augmentation: Literal["randaugment", "none"] = _argument(
        DATA, "randaugment", "What photos go through before the network learns from them."
    )
    on_bad_image: Literal["skip", "error"] = _argument(
        DATA, "skip", "A photo that does not decode: left out, named and counted; or an error."
    )

    backbone_arch: str = _argument(MODEL, "resnet18", "Name of the backbone.")
    pretrained: Bool = _argument(MODEL, True, "Begin with ImageNet weights.")
    weights: Path | None = _argument(
        MODEL, None, "File with the backbone's weights; else the hub's cache."
    )
    layers_to_freeze: int = _argument(
        MODEL, 2, "Freeze up to and with this layer; -1: none.", ge=-1
    )
    layers_to_crop: IntList = _argument(MODEL, (), "JSON list: 4 drops layer4, 3 also layer3.")
    agg_arch: str = _argument(MODEL, "AVG", "Name of the aggregator.")
    agg_config: Annotated[dict[str, Any], BeforeValidator(parse_literal)] = _argument(
        MODEL, {}, "JSON dict: the aggregator's own arguments; channels and map are inferred."
    )

    lr: float = _argument(OPTIMISATION, 2e-4, "Learning rate.", gt=0)
    optimizer: Literal["adam", "adamw", "sgd"] = _argument(OPTIMISATION, "adam", "Which optimiser.")
    weight_decay: float = _argument(OPTIMISATION, 0.0, "Weight decay.", ge=0)
    momentum: float = _argument(OPTIMISATION, 0.9, "Of sgd.", ge=0, lt=1)
    warmpup_steps: int = _argument(
        OPTIMISATION,
        600,
        "Steps in which the learning rate rises linearly; also --warmup_steps.",
        ge=0,
    )
    milestones: IntList = _argument(
        OPTIMISATION, (5, 10, 15, 25), "JSON list of epochs at which lr is multiplied by lr_mult."
    )
    lr_mult: float = _argument(OPTIMISATION, 0.3, "The factor of each milestone.", gt=0)
    max_epochs: int = _argument(OPTIMISATION, 1, "Epochs to learn.", ge=1)
    max_steps: int | None = _argument(
        OPTIMISATION, None, "End after so many steps, also within an epoch.", ge=1
    )
    seed: int = _argument(OPTIMISATION, 1, "Of weights, sampling and augmentation.", ge=0)

    loss_name: str = _argument(LOSS, "MultiSimilarityLoss", "Name of the loss.")
    miner_name: str = _argument(LOSS, "MultiSimilarityMiner", "Name of the miner, or none.")
    miner_margin: float = _argument(
        LOSS, 0.1, "Margin of TripletMarginMiner, epsilon of MultiSimilarityMiner."
    )

    val_set_names: NameList = _argument(
        EVALUATION, ("sfxs_val",), "Sets measured while learning; left out: the folder's own."
    )
    test_set_names: NameList = _argument(
        EVALUATION,
        ("sfxs_test", "tokyoxs_test"),
        "Sets measured by the phases test and all; left out: the folder's own.",
    )
    test_image_size: Annotated[
        Literal["same", "native"] | HeightWidth, BeforeValidator(parse_image_size)
    ] = Field(
        "same",
        description="same as image_size, native (one photo at a time), or H W in pixels.",
        json_schema_extra={"group": EVALUATION},
    )
    faiss_gpu: Bool = _argument(EVALUATION, True, "Search by faiss on the GPU.")
    check_val_every_n_epoch: int = _argument(EVALUATION, 1, "Epochs between validations.", ge=1)
    num_sanity_val_steps: int = _argument(
        EVALUATION, 0, "Validation batches tried before training; -1: all.", ge=-1
    )

    experiment_phase: Literal["train", "test", "all"] = _argument(
        RUN, "train", "train, test (a checkpoint), or all: train, then test the best."
    )
    model_path: Path | None = _argument(
        RUN, None, "Checkpoint that the phase test measures, and that training begins with."
    )
    default_root_dir: str = _argument(RUN, "./LOGS/", "Folder of the runs.")
    run_name: str | None = _argument(RUN, None, "Folder of this run below it; left out: by time.")
    logger: NameList = _argument(
        RUN, ("tensorboard", "csv"), "csv, tensorboard, wandb, mlflow (a list), or none."
    )
    log_every_n_steps: int = _argument(RUN, 20, "Steps between two lines of the logs.", ge=1)
    fast_dev_run: Bool = _argument(RUN, False, "Try one batch of everything; keep nothing.")

    monitor: str = _argument(
        CHECKPOINTS, "sfxs_val/R1", "The metric that decides which checkpoints are best."
    )
    mode: Literal["min", "max"] = _argument(CHECKPOINTS, "max", "Whether more of it is better.")
    save_top_k: int = _argument(
        CHECKPOINTS, 3, "How many best checkpoints stay; -1: all, 0: none.", ge=-1
    )
    save_weights_only: Bool = _argument(
        CHECKPOINTS, True, "Best checkpoints without the optimiser; last.ckpt always has all."
    )
    filename: str = _argument(
        CHECKPOINTS,
        "{backbone_arch}_epoch({epoch:02d})_step({step:04d})_R1[{R1:.4f}]_R5[{R5:.4f}]",
        "Name of a best checkpoint; R1 is the monitored set's, others by SET/R1.",
    )
    auto_insert_metric_name: Bool = _argument(
        CHECKPOINTS, False, "Write a metric's name before its figure."
    )

    accelerator: Literal["gpu", "cuda", "mps", "cpu", "auto"] = _argument(
        MACHINE, "gpu", "What computes."
    )
    devices: Annotated[int | str | tuple[int, ...], BeforeValidator(parse_number_or_text)] = Field(
        (0,), description="Which one: [0], or 1 for any.", json_schema_extra={"group": MACHINE}
    )
    precision: Annotated[int | str, BeforeValidator(parse_number_or_text)] = Field(
        32, description="32, 16-mixed or bf16-mixed.", json_schema_extra={"group": MACHINE}
    )
    reload_dataloaders_every_n_epochs: int = _argument(
        DATA, 1, "Epochs between two shufflings of the places; 0: shuffled once.", ge=0
    )

    @field_validator("image_size")
    @classmethod
    def _check_image_size(cls, size: tuple[int, int]) -> tuple[int, int]:
        if min(size) < MIN_IMAGE_PIXELS:
            raise ValueError(f"each side must be {MIN_IMAGE_PIXELS} pixels or more")
        return size

    @field_validator("filename", "default_root_dir")
    @classmethod
    def _unescape_underscores(cls, text: str) -> str:
        # The predecessor's command writes `\_` inside double quotes, where a shell keeps both.
        return text.replace("\\_", "_")

    @field_validator("model_path", "weights", "run_name", mode="before")
    @classmethod
    def _empty_is_none(cls, value: Any) -> Any:
        return None if value == "" else value

    @field_validator("logger")
    @classmethod
    def _check_loggers(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = ("csv", "tensorboard", "wandb", "mlflow", "none")
        for name in names:
            if name not in known:
                raise ValueError(f"{name!r} is unknown; known: {', '.join(known)}")
        if "none" in names and len(names) > 1:
            raise ValueError("none can't stand beside another logger")
        return tuple(name for name in names if name != "none")


def argument_group(name: str) -> str:
    """The heading of the help under which an argument stands."""
    extra = TrainingArguments.model_fields[name].json_schema_extra
    assert isinstance(extra, dict)
    return str(extra["group"])


def is_boolean(name: str) -> bool:
    """Whether the argument is true or false."""
    return TrainingArguments.model_fields[name].annotation is bool


ALIASES = {"warmup_steps": "warmpup_steps"}
"""how one would spell it: how the predecessor does"""
ARGUMENT_NAMES = tuple(TrainingArguments.model_fields)


def resolve_name(name: str) -> str:
    """`batch-size`, `batch_size` -> `batch_size`; InvalidRequest (`unknown_argument`) otherwise."""
    wanted = name.replace("-", "_")
    wanted = ALIASES.get(wanted, wanted)
    if wanted in ARGUMENT_NAMES:
        return wanted
    raise InvalidRequest(
        "unknown_argument", f"There is no argument {name!r}.{suggest_name(wanted, ARGUMENT_NAMES)}"
    )


def suggest_name(name: str, known: Iterable[str]) -> str:
    """` Did you mean ...?` where something is near, else the list of what is known."""
    names = list(known)
    by_lower = {each.lower(): each for each in names}
    near = difflib.get_close_matches(name.lower(), by_lower, n=1)
    if near:
        return f" Did you mean {by_lower[near[0]]}?"
    return f" Known: {', '.join(names)}."


def load_yaml(path: Path) -> dict[str, Any]:
    """A YAML file's mapping of arguments.

    Raises NotFound (`config_not_found`), InvalidRequest (`bad_config` for what is no mapping,
    `unknown_argument` for a key).
    """
    values = load_mapping(path)
    return resolve_keys(values, str(path))


def load_mapping(path: Path) -> dict[str, Any]:
    """A YAML file's mapping, whatever its keys; the errors of `load_yaml` but the last."""
    import yaml  # of the extra `trainer`; the help is shown without it

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise NotFound("config_not_found", f"Can't read {path}: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InvalidRequest("bad_config", f"{path} is no YAML: {error}") from error
    if loaded is None:
        return {}
    if not isinstance(loaded, dict) or not all(isinstance(key, str) for key in loaded):
        raise InvalidRequest("bad_config", f"{path}: names with values are needed (`lr: 0.0002`).")
    return loaded


def resolve_keys(values: Mapping[str, Any], source: str) -> dict[str, Any]:
    """The values under their arguments' names; InvalidRequest names the place for one unknown."""
    found: dict[str, Any] = {}
    for key, value in values.items():
        try:
            found[resolve_name(key)] = value
        except InvalidRequest as error:
            raise InvalidRequest(error.code, f"{source}: {error.detail}") from error
    return found


def build_arguments(*layers: Mapping[str, Any]) -> TrainingArguments:
    """Checked arguments; a later layer overrides an earlier one.

    Raises InvalidRequest (`bad_argument`) that names each argument that can't be so.
    """
    merged: dict[str, Any] = {}
    for layer in layers:
        merged.update(layer)
    try:
        return TrainingArguments(**merged)
    except ValidationError as error:
        faults = [
            f"--{fault['loc'][0]}: {fault['msg'].removeprefix('Value error, ')} "
            f"(got {fault['input']!r})"
            for fault in error.errors()
        ]
        raise InvalidRequest("bad_argument", "; ".join(dict.fromkeys(faults))) from error


def to_plain_dict(arguments: TrainingArguments) -> dict[str, Any]:
    """Every argument as text, numbers, lists and dicts: what YAML and JSON hold."""
    plain: dict[str, Any] = arguments.model_dump(mode="json")
    return plain


def save_yaml(arguments: TrainingArguments, path: Path) -> None:
    """The file from which the same run can be made."""
    import yaml

    text = yaml.safe_dump(to_plain_dict(arguments), sort_keys=False, allow_unicode=True)
    path.write_text("# Every argument of this run: placewise train --config THIS\n" + text)
