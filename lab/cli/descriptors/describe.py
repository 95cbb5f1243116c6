"""`placewise describe PHOTOS --out FILE`: compute descriptors of photos without a server."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from services.cli.environment import read_settings, require_packages
from services.cli.output import JsonOption, print_result, progress_bar
from shared.errors import InvalidRequest
from shared.extractor_config.configs import get_extractor_config


def describe(
    photos: Annotated[
        list[Path], typer.Argument(metavar="PHOTOS...", help="Photo files, in row order.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE.npy|FILE.h5",
            help="Output file: one row per photo (.npy), or hloc global features (.h5).",
        ),
    ],
    extractor: Annotated[
        str | None,
        typer.Option(
            help="Extractor name, with options as in EXTRACTOR. Default: the setting EXTRACTOR.",
        ),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="Checkpoint of `placewise train`, instead of --extractor.",
        ),
    ] = None,
    weights: Annotated[
        Path | None,
        typer.Option(help="DINOv2 weights: .pth, .pt or .safetensors."),
    ] = None,
    vocabulary: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="VLAD vocabulary: .npz of `vocabulary export`, .npy, or AnyLoc's c_centers.pt.",
        ),
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            file_okay=False,
            help="With FILE.h5: name photos by paths relative to this folder. Default: as given.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Compute descriptors of photos and write them to a file.

    A .npy file contains one float32 row per photo, in the given order. An .h5 file contains a group
    per photo with the dataset `global_descriptor`. If a photo can't be described, it is reported
    and no file is written.
    """
    names = _hdf5_names(photos, out, root)
    settings = read_settings()
    if checkpoint is not None:
        if extractor is not None:
            raise InvalidRequest(
                "options_contradict", "--checkpoint and --extractor exclude each other."
            )
        extractor = f"gsv:{checkpoint.absolute()}"
    name = extractor or settings.new_map_extractor
    config = get_extractor_config(name, allow_test_extractors=settings.allow_test_extractors)
    if weights is not None:
        if config.depth is None:
            raise InvalidRequest(
                "weights_unused",
                f"--weights applies only to extractors based on DINOv2, not to {config.name}.",
            )
        settings = settings.model_copy(update={"dino_weights": weights.absolute()})

    from lab.cli.descriptors.describe_files import describe_files

    with progress_bar() as progress:
        bar = progress.add_task("describing", total=len(photos))
        result = describe_files(
            photos,
            out,
            config,
            vocabulary,
            settings,
            lambda n: progress.advance(bar, n),
            names=names,
        )
    print_result(
        result,
        as_json,
        f"Wrote {result['rows']} rows of {result['dimension']} dimensions to {result['file']} "
        f"({config.name}, {result['seconds']['total']:.1f} s).",
    )


def _hdf5_names(photos: Sequence[Path], out: Path, root: Path | None) -> list[str] | None:
    """The names of the photos in an .h5 file; None for an .npy file."""
    if out.suffix not in (".h5", ".hdf5"):
        if root is not None:
            raise InvalidRequest("options_contradict", "--root requires --out FILE.h5.")
        return None
    require_packages("h5py")
    try:
        paths = [(p.absolute().relative_to(root.absolute()) if root else p) for p in photos]
    except ValueError as error:
        raise InvalidRequest("bad_names", f"All photos must be below --root: {error}.") from error
    names = [path.as_posix().lstrip("/") for path in paths]
    duplicates = [name for name, count in Counter(names).items() if count > 1]
    if duplicates:
        raise InvalidRequest(
            "bad_names", f"{duplicates[0]} is given more than once. Names must be unique."
        )
    return names
