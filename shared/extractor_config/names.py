"""Parsers of the extractor names `gsv:...` (trained models) and `torchhub:...` (torch.hub entries).

    gsv:night-walks                      a model that was added; fetched from the object store
    gsv:/folder/best.ckpt                a checkpoint file of this machine, for commands only
    torchhub:gmberton/eigenplaces@<40 hex digits>:get_trained_model:backbone=ResNet18
    torchhub:/models/mine:my_entry:input.size=322x322

A torch.hub entry executes third-party code, so that a repository is pinned to a commit, and a
folder to a fingerprint of its content, which is part of the extractor spec. Options without a dot
are keyword arguments of the entry; options `input.…` set the network's input.

Imports no torch and reads no file: the gateway parses names, extractors load what they denote.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from shared.errors import Misconfigured

TRAINED_MODEL_PREFIX = "gsv:"
MODEL_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
MODEL_NAME_RULE = (
    "a model name has up to 100 letters, digits, `.`, `_` and `-`, and begins with a letter or "
    "digit"
)
MAX_PATH_CHARACTERS = 190  # extractor names in the catalog have at most 200


@dataclass(frozen=True, slots=True)
class TrainedModelName:
    """A parsed `gsv:` name. Exactly one of the fields is set."""

    registered: str | None
    """Name under which the model was added."""
    file: str | None
    """Absolute path of a checkpoint file."""

    @property
    def extractor(self) -> str:
        """The extractor's canonical name."""
        return f"{TRAINED_MODEL_PREFIX}{self.registered or self.file}"


def parse_trained_model_name(extractor: str) -> TrainedModelName:
    """Parse an extractor name that begins with `gsv:`.

    Raises:
        Misconfigured: `bad_model_name`.
    """
    rest = extractor.removeprefix(TRAINED_MODEL_PREFIX)
    if rest.startswith("/"):
        if len(rest) > MAX_PATH_CHARACTERS or "\x00" in rest:
            raise Misconfigured(
                "bad_model_name",
                f"The path in {extractor!r} has more than {MAX_PATH_CHARACTERS} characters, or "
                "a NUL character.",
            )
        return TrainedModelName(None, rest)
    if not re.fullmatch(MODEL_NAME_PATTERN, rest):
        raise Misconfigured(
            "bad_model_name",
            f"The extractor name {extractor!r} is invalid: {MODEL_NAME_RULE}. Use "
            f"{TRAINED_MODEL_PREFIX}NAME for a model that was added, or "
            f"{TRAINED_MODEL_PREFIX}/FOLDER/FILE for a checkpoint.",
        )
    return TrainedModelName(rest, None)


TORCHHUB_PREFIX = "torchhub:"
MAX_TORCHHUB_NAME_CHARACTERS = 200  # size of the catalog's columns
INPUT_SIDES_PIXELS = range(16, 2049)
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DEFAULT_INPUT_SIDE_PIXELS = 224  # a multiple of the patch sizes 14, 16 and 32

HubArgument = str | int | float | bool | None
HUB_ARGUMENT_LITERALS: dict[str, HubArgument] = {"true": True, "false": False, "none": None}


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
    height: int = DEFAULT_INPUT_SIDE_PIXELS
    """Input height in pixels."""
    width: int = DEFAULT_INPUT_SIDE_PIXELS
    """Input width in pixels."""
    mean: tuple[float, ...] = IMAGENET_MEAN
    """Mean of red, green and blue for normalisation, each from 0 to 1."""
    std: tuple[float, ...] = IMAGENET_STD
    """Standard deviation of the channels, as `mean`."""

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
        return _join(self, sorted(_argument_options(self) + _input_options(self)))


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
    default_input = TorchHubEntry(repository, commit, folder, entry, tuple(arguments.items()))
    hub = replace(default_input, **_parse_input(name, options))
    if len(hub.name) > MAX_TORCHHUB_NAME_CHARACTERS:
        _raise_bad_name(
            name,
            f"it has {len(hub.name)} characters, the maximum is {MAX_TORCHHUB_NAME_CHARACTERS}",
        )
    return hub


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


def _parse_input(name: str, options: dict[str, str]) -> dict[str, Any]:
    """Return the fields of TorchHubEntry that the options `input.…` set."""
    fields: dict[str, Any] = {}
    for option, value in options.items():
        if "." not in option:
            continue
        if option == "input.size":
            match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", value)
            if match is None or not all(int(side) in INPUT_SIDES_PIXELS for side in match.groups()):
                _raise_bad_option(
                    name,
                    f"{option}={value} is not HEIGHTxWIDTH, each {INPUT_SIDES_PIXELS[0]} to "
                    f"{INPUT_SIDES_PIXELS[-1]}",
                )
            fields["height"], fields["width"] = (int(side) for side in match.groups())
        elif option in ("input.mean", "input.std"):
            fields[option.removeprefix("input.")] = _parse_channels(name, option, value)
        else:
            _raise_bad_option(name, f"{option} is not one of input.size, input.mean, input.std")
    return fields


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


def _input_options(hub: TorchHubEntry) -> list[str]:
    """Return the options of the network's input that differ from the defaults."""
    options = []
    if hub.mean != IMAGENET_MEAN:
        options.append(f"input.mean={'/'.join(map(repr, hub.mean))}")
    if (hub.height, hub.width) != (DEFAULT_INPUT_SIDE_PIXELS, DEFAULT_INPUT_SIDE_PIXELS):
        options.append(f"input.size={hub.height}x{hub.width}")
    if hub.std != IMAGENET_STD:
        options.append(f"input.std={'/'.join(map(repr, hub.std))}")
    return options


def _join(hub: TorchHubEntry, options: list[str]) -> str:
    name = f"{TORCHHUB_PREFIX}{hub.source}:{hub.entry}"
    return f"{name}:{','.join(options)}" if options else name


def _raise_bad_option(name: str, fault: str) -> NoReturn:
    raise Misconfigured(
        "bad_extractor_option",
        f"The options of {name!r} are invalid: {fault}. Options are NAME=VALUE, separated by "
        "commas: arguments of the entry, and input.size, input.mean, input.std.",
    )


def _raise_bad_name(name: str, fault: str) -> NoReturn:
    raise Misconfigured(
        "bad_torchhub_name",
        f"The extractor name {name!r} is invalid: {fault}. Use "
        f"{TORCHHUB_PREFIX}OWNER/NAME@COMMIT:ENTRY or {TORCHHUB_PREFIX}/FOLDER:ENTRY, and append "
        "options as :OPTION=VALUE,...",
    )
