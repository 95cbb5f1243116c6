"""Parsers of extractor names that begin with a prefix: models, exported networks, torch.hub.

    gsv:night-walks                      a model that was added; fetched from the object store
    gsv:/folder/best.ckpt                a checkpoint file of this machine, for commands only
    torchscript:sscd:input.size=288x288  a TorchScript file that was added, and its input
    onnx:/folder/net.onnx                an ONNX file of this machine, for commands only
    torchhub:gmberton/eigenplaces@<40 hex digits>:get_trained_model:backbone=ResNet18
    torchhub:/models/mine:my_entry:input.size=322x322

A torch.hub entry executes third-party code, so that a repository is pinned to a commit, and a
folder to a fingerprint of its content, which is part of the extractor spec. Options without a dot
are keyword arguments of the entry, or of a file's aggregator; options `input.…` set the network's
input.

Imports no torch and reads no file: the gateway parses names, extractors load what they denote.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, NoReturn

from shared.errors import Misconfigured

TRAINED_MODEL_PREFIX = "gsv:"
TORCHSCRIPT_PREFIX, ONNX_PREFIX = "torchscript:", "onnx:"
EXPORT_PREFIXES = (TORCHSCRIPT_PREFIX, ONNX_PREFIX)
MODEL_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
MODEL_NAME_RULE = (
    "a model name has up to 100 letters, digits, `.`, `_` and `-`, and begins with a letter or "
    "digit"
)
MAX_PATH_CHARACTERS = 190  # extractor names in the catalog have at most 200


@dataclass(frozen=True, slots=True)
class ModelName:
    """Name of a trained model or exported network; either `registered` or `file` is set."""

    registered: str | None
    """Name under which the model was added."""
    file: str | None
    """Absolute path of a checkpoint, or of a TorchScript or ONNX file."""
    prefix: str = TRAINED_MODEL_PREFIX

    @property
    def extractor(self) -> str:
        """The extractor's name, without options."""
        return f"{self.prefix}{self.registered or self.file}"


def parse_model_name(extractor: str) -> ModelName:
    """Parse an extractor name without options: `gsv:`, `torchscript:` or `onnx:`.

    Raises:
        Misconfigured: `bad_model_name`.
    """
    prefix, _, rest = extractor.partition(":")
    prefix += ":"
    if rest.startswith("/"):
        if len(rest) > MAX_PATH_CHARACTERS or "\x00" in rest:
            raise Misconfigured(
                "bad_model_name",
                f"The path in {extractor!r} has more than {MAX_PATH_CHARACTERS} characters, or "
                "a NUL character.",
            )
        return ModelName(None, rest, prefix)
    if not re.fullmatch(MODEL_NAME_PATTERN, rest):
        raise Misconfigured(
            "bad_model_name",
            f"The extractor name {extractor!r} is invalid: {MODEL_NAME_RULE}. Use "
            f"{prefix}NAME for a model that was added, or {prefix}/FOLDER/FILE for a file.",
        )
    return ModelName(rest, None, prefix)


TORCHHUB_PREFIX = "torchhub:"
MAX_NAME_CHARACTERS = 200  # size of the catalog's columns
INPUT_SIDES_PIXELS = range(16, 2049)
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DEFAULT_INPUT_SIDE_PIXELS = 224  # a multiple of the patch sizes 14, 16 and 32

HubArgument = str | int | float | bool | None
HUB_ARGUMENT_LITERALS: dict[str, HubArgument] = {"true": True, "false": False, "none": None}


NATIVE_SIZE = "native"
VALUE_RANGES = ("uint8", "255", "1")
LAYOUTS = ("nchw", "nhwc")
INPUT_CHOICES = {"range": VALUE_RANGES, "layout": LAYOUTS}
INPUT_OPTIONS = "input.size, input.mean, input.std, input.range and input.layout"


@dataclass(frozen=True, slots=True)
class NetworkInput:
    """What a network of others expects: the options `input.…`."""

    height: int | None = DEFAULT_INPUT_SIDE_PIXELS
    """Pixels; None, as `width`, for the photo's own size (the preprocessing `native1024`)."""
    width: int | None = DEFAULT_INPUT_SIDE_PIXELS
    mean: tuple[float, ...] = IMAGENET_MEAN
    """Mean of red, green and blue for normalisation, each from 0 to 1."""
    std: tuple[float, ...] = IMAGENET_STD
    """Standard deviation of the channels, as `mean`."""
    range: str | None = None
    """One of VALUE_RANGES: bytes, or floats from 0 to 255 or 1; None: by `mean` and `std`."""
    layout: str = LAYOUTS[0]
    """One of LAYOUTS: (B, 3, H, W) or (B, H, W, 3)."""

    @property
    def preprocessing(self) -> str:
        """Name of the preprocessing that makes photos of this size."""
        if self.height is None:
            return "native1024"
        side = DEFAULT_INPUT_SIDE_PIXELS
        is_default = self.height == self.width == side
        return f"square{side}" if is_default else f"resize{self.height}x{self.width}"

    @property
    def options(self) -> list[str]:
        """The options that differ from the defaults."""
        size = NATIVE_SIZE if self.height is None else f"{self.height}x{self.width}"
        values = {
            "size": (size, f"{DEFAULT_INPUT_SIDE_PIXELS}x{DEFAULT_INPUT_SIDE_PIXELS}"),
            "mean": ("/".join(map(repr, self.mean)), "/".join(map(repr, IMAGENET_MEAN))),
            "std": ("/".join(map(repr, self.std)), "/".join(map(repr, IMAGENET_STD))),
            "range": (self.range, None),
            "layout": (self.layout, LAYOUTS[0]),
        }
        return [f"input.{o}={value}" for o, (value, default) in values.items() if value != default]


DEFAULT_INPUT = NetworkInput()


@dataclass(frozen=True, slots=True)
class TorchHubEntry:
    """An entry point of a `hubconf.py`, its arguments, and the input of its network."""

    repository: str | None
    """`owner/name` on GitHub; None for a folder of this machine."""
    commit: str | None
    """40 hexadecimal digits; None for a folder."""
    folder: str | None
    """Absolute path; None for a repository."""
    entry: str
    arguments: tuple[tuple[str, HubArgument], ...] = ()
    """Keyword arguments of the entry, by name."""
    input: NetworkInput = DEFAULT_INPUT

    @property
    def source(self) -> str:
        """Source of the code: `owner/name@commit`, or the folder."""
        return self.folder or f"{self.repository}@{self.commit}"

    @property
    def module(self) -> str:
        """Name of the network, without the options of its input."""
        return _join(self, _argument_options(self))

    @property
    def name(self) -> str:
        """Canonical name: options in alphabetical order, without the default input."""
        return _join(self, sorted(_argument_options(self) + self.input.options))


def parse_torchhub_name(name: str) -> TorchHubEntry:
    """Parse an extractor name that begins with `torchhub:`.

    Raises:
        Misconfigured: `torchhub_unpinned` (with instructions), `bad_torchhub_name`,
            `bad_extractor_option`.
    """
    source, _, rest = name.removeprefix(TORCHHUB_PREFIX).partition(":")
    entry, colon, option_text = rest.partition(":")
    if not entry.isidentifier() or not source:
        _raise_bad_name(name, "after the repository comes the entry of its hubconf.py")
    options = _parse_options(name, option_text) if colon else {}
    arguments = {o: _parse_argument(v) for o, v in sorted(options.items()) if "." not in o}
    repository, commit, folder = _parse_source(name, source)
    network_input = _parse_input(name, options)
    hub = TorchHubEntry(repository, commit, folder, entry, tuple(arguments.items()), network_input)
    if len(hub.name) > MAX_NAME_CHARACTERS:
        _raise_bad_name(
            name,
            f"it has {len(hub.name)} characters, the maximum is {MAX_NAME_CHARACTERS}",
        )
    return hub


def parse_exported_name(name: str) -> tuple[ModelName, NetworkInput, str]:
    """Parse an extractor name that begins with `torchscript:` or `onnx:`.

    Returns:
        The file, its network's input, and the options of the aggregator as they are.

    Raises:
        Misconfigured: `bad_model_name`, `bad_extractor_option`.
    """
    prefix, _, rest = name.partition(":")
    source, colon, option_text = rest.partition(":")
    model = parse_model_name(f"{prefix}:{source}")
    options = _parse_options(name, option_text) if colon else {}
    rest = ",".join(f"{o}={value}" for o, value in options.items() if "." not in o)
    return model, _parse_input(name, options), rest


def _parse_source(name: str, source: str) -> tuple[str | None, str | None, str | None]:
    if source.startswith("/"):
        if not re.fullmatch(r"[^\s\x00-\x1f]+", source):
            _raise_bad_name(name, "the folder's path contains a blank")
        return None, None, source.rstrip("/") or "/"
    repository, _, commit = source.partition("@")
    if not re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", repository, re.ASCII):
        _raise_bad_name(name, "a repository is OWNER/NAME on GitHub, a folder begins with /")
    if not re.fullmatch(r"[0-9a-f]{40}", commit.lower()):
        raise Misconfigured(
            "torchhub_unpinned",
            f"The extractor {name!r} would execute whatever code {repository} has on GitHub at the "
            "time. Pin it to a commit that you have reviewed, with all 40 hexadecimal digits: "
            f"{TORCHHUB_PREFIX}{repository}@COMMIT:ENTRY. "
            f"`git ls-remote https://github.com/{repository} HEAD` prints the newest commit.",
        )
    return repository, commit.lower(), None


def _parse_options(name: str, option_text: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for part in option_text.split(","):
        option, equals, value = part.partition("=")
        if not equals or not option.removeprefix("input.").isidentifier() or not value.strip():
            _raise_bad_option(name, f"{part!r} is not option=value")
        if not re.fullmatch(r"[!-~]+", value):
            _raise_bad_option(
                name, f"the value of {option} contains other than visible ASCII characters"
            )
        if option in options:
            _raise_bad_option(name, f"{option} is given twice")
        options[option] = value
    return options


def _parse_input(name: str, options: dict[str, str]) -> NetworkInput:
    fields: dict[str, Any] = {}
    for option, value in options.items():
        if "." not in option:
            continue
        field = option.removeprefix("input.")
        if option == "input.size" and value == NATIVE_SIZE:
            fields |= {"height": None, "width": None}
        elif option == "input.size":
            match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", value)
            if match is None or not all(int(side) in INPUT_SIDES_PIXELS for side in match.groups()):
                _raise_bad_option(
                    name,
                    f"{option}={value} is neither {NATIVE_SIZE} nor HEIGHTxWIDTH, each "
                    f"{INPUT_SIDES_PIXELS[0]} to {INPUT_SIDES_PIXELS[-1]}",
                )
            fields["height"], fields["width"] = (int(side) for side in match.groups())
        elif option in ("input.mean", "input.std"):
            fields[field] = _parse_channels(name, option, value)
        elif field in INPUT_CHOICES:
            if value not in INPUT_CHOICES[field]:
                choices = ", ".join(INPUT_CHOICES[field])
                _raise_bad_option(name, f"{option}={value} is not one of {choices}")
            fields[field] = value
        else:
            _raise_bad_option(name, f"{option} is not one of {INPUT_OPTIONS}")
    if "range" in fields and fields.keys() & {"mean", "std"}:
        _raise_bad_option(name, "input.range excludes input.mean and input.std")
    return NetworkInput(**fields)


def _parse_channels(name: str, option: str, value: str) -> tuple[float, ...]:
    try:
        channels = tuple(float(part) for part in value.split("/"))
    except ValueError:
        channels = ()
    minimum = 0.0 if option == "input.mean" else 0.001
    if len(channels) != 3 or not all(minimum <= channel <= 1 for channel in channels):
        _raise_bad_option(
            name,
            f"{option}={value} is not RED/GREEN/BLUE, {minimum:g} to 1 each, such as 0.5/0.5/0.5",
        )
    return channels


def _parse_argument(text: str) -> HubArgument:
    if text.lower() in HUB_ARGUMENT_LITERALS:
        return HUB_ARGUMENT_LITERALS[text.lower()]
    if re.fullmatch(r"-?[0-9]+", text):
        return int(text)
    if re.fullmatch(r"-?[0-9]*\.?[0-9]+(e[+-]?[0-9]+)?", text):
        return float(text)
    return text


def _argument_options(hub: TorchHubEntry) -> list[str]:
    return [f"{option}={value}" for option, value in hub.arguments]


def _join(hub: TorchHubEntry, options: list[str]) -> str:
    name = f"{TORCHHUB_PREFIX}{hub.source}:{hub.entry}"
    return f"{name}:{','.join(options)}" if options else name


def _raise_bad_option(name: str, fault: str) -> NoReturn:
    raise Misconfigured(
        "bad_extractor_option",
        f"The options of {name!r} are invalid: {fault}. Options are NAME=VALUE, separated by "
        f"commas: those of the network's input are {INPUT_OPTIONS}; others are arguments of a "
        "torch.hub entry, or the aggregator of a file.",
    )


def _raise_bad_name(name: str, fault: str) -> NoReturn:
    raise Misconfigured(
        "bad_torchhub_name",
        f"The extractor name {name!r} is invalid: {fault}. Use "
        f"{TORCHHUB_PREFIX}OWNER/NAME@COMMIT:ENTRY or {TORCHHUB_PREFIX}/FOLDER:ENTRY, and append "
        "options as :OPTION=VALUE,...",
    )
