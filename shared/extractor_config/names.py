"""Names of models that were trained and added: `gsv:N`, or `gsv:/folder/best.ckpt` for a file.

A registered model `N` is fetched from the object store by whoever describes photos with it. A file
of this machine is for the commands alone: no other machine has it.

Imports no torch, and looks at no file.

Names of torch.hub extractors: whose code, which commit of it, which entry, with what.

    torchhub:gmberton/eigenplaces@<40 hex digits>:get_trained_model:backbone=ResNet18
    torchhub:/models/mine:my_entry:input.size=322x322

Code of others is executed, so a repository is pinned to a commit; a folder is pinned by a
fingerprint of what lies in it, which is part of the extractor spec. Options without a dot are the
entry's own keyword arguments; those with one say what the network wants to see.

Imports no torch, and looks at no file: the gateway reads names, extractors load what they mean.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from shared.errors import Misconfigured

TRAINED_MODEL_PREFIX = "gsv:"
MODEL_NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,99}$"
MODEL_NAME_RULE = (
    "a model's name has up to 100 letters, digits, `.`, `_` and `-`, and begins with a letter or "
    "digit"
)
MAX_PATH_CHARACTERS = 190  # columns of the catalog hold names of 200


@dataclass(frozen=True, slots=True)
class TrainedModelName:
    """Exactly one of the two is set."""

    registered: str | None
    """The name that it was added under."""
    file: str | None
    """Absolute path of a checkpoint."""

    @property
    def extractor(self) -> str:
        """The extractor's canonical name."""
        return f"{TRAINED_MODEL_PREFIX}{self.registered or self.file}"


def parse_trained_model_name(extractor: str) -> TrainedModelName:
    """What an extractor's name that begins with `gsv:` means.

    Misconfigured: `bad_model_name`.
    """
    rest = extractor.removeprefix(TRAINED_MODEL_PREFIX)
    if rest.startswith("/"):
        if len(rest) > MAX_PATH_CHARACTERS or "\x00" in rest:
            raise Misconfigured(
                "bad_model_name",
                f"The path in {extractor!r} has more than {MAX_PATH_CHARACTERS} characters, or "
                "one that no path has.",
            )
        return TrainedModelName(None, rest)
    if not re.fullmatch(MODEL_NAME_PATTERN, rest):
        raise Misconfigured(
            "bad_model_name",
            f"The extractor {extractor!r} can't be read: {MODEL_NAME_RULE}. It is written "
            f"{TRAINED_MODEL_PREFIX}NAME for a model that was added, or "
            f"{TRAINED_MODEL_PREFIX}/FOLDER/FILE for a checkpoint.",
        )
    return TrainedModelName(rest, None)


TORCHHUB_PREFIX = "torchhub:"
MAX_TORCHHUB_NAME_CHARACTERS = 200  # of a name, which columns of the catalog hold
INPUT_SIDES_PIXELS = range(16, 2049)  # pixels
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
DEFAULT_INPUT_SIDE_PIXELS = 224  # whole patches of 14, 16 and 32 pixels

HubArgument = str | int | float | bool | None
HUB_ARGUMENT_LITERALS: dict[str, HubArgument] = {"true": True, "false": False, "none": None}


@dataclass(frozen=True, slots=True)
class TorchHubEntry:
    """An entry of a `hubconf.py`, its arguments, and the photos that its network wants."""

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
    """pixels"""
    width: int = DEFAULT_INPUT_SIDE_PIXELS
    """pixels"""
    mean: tuple[float, ...] = IMAGENET_MEAN
    """Of red, green and blue, each from 0 to 1."""
    std: tuple[float, ...] = IMAGENET_STD

    @property
    def source(self) -> str:
        """Whose code: `owner/name@commit`, or the folder."""
        return self.folder or f"{self.repository}@{self.commit}"

    @property
    def module(self) -> str:
        """The name of the network, without what it is shown."""
        return _join(self, _arguments(self))

    @property
    def name(self) -> str:
        """The canonical name: options in the alphabet's order, without the usual input."""
        return _join(self, sorted(_arguments(self) + _input(self)))


def parse_torchhub_name(name: str) -> TorchHubEntry:
    """What a name that begins with `torchhub:` means.

    Misconfigured: `torchhub_unpinned` (saying how to pin), `bad_torchhub_name`,
    `bad_extractor_option`.
    """
    source, _, rest = name.removeprefix(TORCHHUB_PREFIX).partition(":")
    entry, colon, written = rest.partition(":")
    if not entry.isidentifier() or not source:
        _raise_bad_name(name, "after the repository comes the entry of its hubconf.py")
    options = _parse_options(name, written) if colon else {}
    arguments = {o: _parse_argument(v) for o, v in sorted(options.items()) if "." not in o}
    repository, commit, folder = _parse_source(name, source)
    plain = TorchHubEntry(repository, commit, folder, entry, tuple(arguments.items()))
    made = replace(plain, **_parse_input(name, options))
    if len(made.name) > MAX_TORCHHUB_NAME_CHARACTERS:
        _raise_bad_name(
            name, f"it may have {MAX_TORCHHUB_NAME_CHARACTERS} characters, and has {len(made.name)}"
        )
    return made


def _parse_source(name: str, source: str) -> tuple[str | None, str | None, str | None]:
    if source.startswith("/"):
        if not re.fullmatch(r"[^\s\x00-\x1f]+", source):
            _raise_bad_name(name, "the folder's path holds a blank")
        return None, None, source.rstrip("/") or "/"
    repository, _, commit = source.partition("@")
    if not re.fullmatch(r"[\w-][\w.-]*/[\w-][\w.-]*", repository, re.ASCII):
        _raise_bad_name(name, "a repository is OWNER/NAME on GitHub, a folder begins with /")
    if not re.fullmatch(r"[0-9a-f]{40}", commit.lower()):
        raise Misconfigured(
            "torchhub_unpinned",
            f"The extractor {name!r} would run whatever code {repository} has on GitHub that day. "
            "Pin it to a commit that you have looked at: "
            f"{TORCHHUB_PREFIX}{repository}@COMMIT:ENTRY with "
            "all 40 hexadecimal digits of the commit. "
            f"`git ls-remote https://github.com/{repository} HEAD` prints the newest one.",
        )
    return repository, commit.lower(), None


def _parse_options(name: str, written: str) -> dict[str, str]:
    options: dict[str, str] = {}
    for part in written.split(","):
        option, equals, value = part.partition("=")
        if not equals or not option.removeprefix("input.").isidentifier() or not value.strip():
            _bad_option(name, f"{part!r} is no option=value")
        if not re.fullmatch(r"[!-~]+", value):
            _bad_option(name, f"the value of {option} holds more than visible ASCII characters")
        if option in options:
            _bad_option(name, f"{option} is given twice")
        options[option] = value
    return options


def _parse_input(name: str, options: dict[str, str]) -> dict[str, Any]:
    """The fields of HubEntry that the options `input.…` give."""
    given: dict[str, Any] = {}
    for option, value in options.items():
        if "." not in option:
            continue
        if option == "input.size":
            match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", value)
            if match is None or not all(int(side) in INPUT_SIDES_PIXELS for side in match.groups()):
                _bad_option(
                    name,
                    f"{option}={value} is not HEIGHTxWIDTH, each {INPUT_SIDES_PIXELS[0]} to "
                    f"{INPUT_SIDES_PIXELS[-1]}",
                )
            given["height"], given["width"] = (int(side) for side in match.groups())
        elif option in ("input.mean", "input.std"):
            given[option.removeprefix("input.")] = _channels(name, option, value)
        else:
            _bad_option(name, f"{option} is none of input.size, input.mean, input.std")
    return given


def _channels(name: str, option: str, value: str) -> tuple[float, ...]:
    try:
        channels = tuple(float(part) for part in value.split("/"))
    except ValueError:
        channels = ()
    least = 0.0 if option == "input.mean" else 0.001
    if len(channels) != 3 or not all(least <= channel <= 1 for channel in channels):
        _bad_option(
            name, f"{option}={value} is not RED/GREEN/BLUE, {least:g} to 1 each, as 0.5/0.5/0.5"
        )
    return channels


def _parse_argument(written: str) -> HubArgument:
    if written.lower() in HUB_ARGUMENT_LITERALS:
        return HUB_ARGUMENT_LITERALS[written.lower()]
    if re.fullmatch(r"-?[0-9]+", written):
        return int(written)
    if re.fullmatch(r"-?[0-9]*\.?[0-9]+(e[+-]?[0-9]+)?", written):
        return float(written)
    return written


def _arguments(hub: TorchHubEntry) -> list[str]:
    return [f"{option}={value}" for option, value in hub.arguments]


def _input(hub: TorchHubEntry) -> list[str]:
    """What the network is shown, where it is not the usual."""
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


def _bad_option(name: str, fault: str) -> NoReturn:
    raise Misconfigured(
        "bad_extractor_option",
        f"The options of {name!r} can't be used: {fault}. Options are NAME=VALUE, separated by "
        "commas: arguments of the entry, and input.size, input.mean, input.std.",
    )


def _raise_bad_name(name: str, fault: str) -> NoReturn:
    raise Misconfigured(
        "bad_torchhub_name",
        f"The extractor {name!r} can't be read: {fault}. It is written "
        f"{TORCHHUB_PREFIX}OWNER/NAME@COMMIT:ENTRY or {TORCHHUB_PREFIX}/FOLDER:ENTRY, then "
        ":OPTION=VALUE,...",
    )
