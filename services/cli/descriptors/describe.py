"""`placewise describe PHOTOS... --out FILE.npy`: descriptors of photos, without a server."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from services.cli.environment import read_settings, require_packages
from services.cli.extractor_options import (
    AggregatorOption,
    BackboneOption,
    FacetOption,
    LayerOption,
    PreprocessingOption,
    TemperatureOption,
    extractor_name,
)
from services.cli.output import (
    JsonOption,
    console,
    print_json,
    printable_path,
    progress_bar,
    report_errors,
)
from shared.errors import InvalidRequest
from shared.extractor_config.configs import get_extractor_config


def describe(
    photos: Annotated[list[Path], typer.Argument(metavar="PHOTOS...", help="Files, in order.")],
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            metavar="FILE.npy|FILE.h5",
            help="What to write: a row for each photo; as .h5, hloc's global features by name.",
        ),
    ],
    extractor: Annotated[
        str | None,
        typer.Option(
            "--extractor", help="By name, with options as in EXTRACTOR; left out: of new maps."
        ),
    ] = None,
    backbone: BackboneOption = None,
    weights: Annotated[
        Path | None,
        typer.Option("--weights", help="DINOv2's weights: .pth, .pt or .safetensors."),
    ] = None,
    layer: LayerOption = None,
    facet: FacetOption = None,
    preprocessing: PreprocessingOption = None,
    aggregator: AggregatorOption = None,
    temperature: TemperatureOption = None,
    vocabulary: Annotated[
        Path | None,
        typer.Option(
            "--vocabulary",
            exists=True,
            dir_okay=False,
            help="Of VLAD: .npz of `vocabulary fit`, .npy, or AnyLoc's c_centers.pt.",
        ),
    ] = None,
    pca: Annotated[
        Path | None,
        typer.Option(
            "--pca",
            exists=True,
            dir_okay=False,
            help="Shorten the rows: .safetensors of `pca fit ROWS.npy` or `pca fit DIR`.",
        ),
    ] = None,
    root: Annotated[
        Path | None,
        typer.Option(
            "--root",
            exists=True,
            file_okay=False,
            help="With FILE.h5: photos are named from this folder on; left out: as they are given.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write the descriptors of photos into a .npy file: float32, a row for each, in their order.

    Into an .h5 file: a group for each photo's name with a dataset `global_descriptor`. A photo that
    can't be described is named, and then no file is written at all.
    """
    # Read when torch is loaded, which is below; see services/cli/__init__.py.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with report_errors(as_json):
        names = _hdf5_names(photos, out, root)
        settings = read_settings()
        name = extractor_name(
            extractor or (settings.new_map_extractor if backbone is None else None),
            backbone,
            layer=layer,
            facet=facet,
            preprocessing=preprocessing,
            aggregator=aggregator,
            temperature=temperature,
        )
        recipe = get_extractor_config(name, allow_test_extractors=settings.allow_test_extractors)
        if weights is not None:
            if recipe.depth is None:
                raise InvalidRequest(
                    "weights_unused",
                    f"The extractor {recipe.name} brings its own weights; --weights is for those "
                    "on DINOv2.",
                )
            settings = settings.model_copy(update={"dino_weights": weights.absolute()})

        from services.cli.descriptors.local_extractor import describe_files

        with progress_bar() as progress:
            bar = progress.add_task("describing", total=len(photos))
            found = describe_files(
                photos,
                out,
                recipe,
                vocabulary,
                pca,
                settings,
                lambda n: progress.advance(bar, n),
                names=names,
            )
    if as_json:
        print_json(found.as_json())
        return
    console.print(
        f"{found.rows} rows of {found.spec['dimension']} numbers are in {printable_path(out)} "
        f"({recipe.name}, {found.seconds['total']:.1f} s).",
        soft_wrap=True,
        markup=False,
    )


def _hdf5_names(photos: Sequence[Path], out: Path, root: Path | None) -> list[str] | None:
    """What an .h5 file calls the photos; None for a file of rows alone.

    InvalidRequest: `options_contradict`, `bad_names` (not below the root, or the same name twice);
    Misconfigured (`trainer_missing`).
    """
    if out.suffix not in (".h5", ".hdf5"):
        if root is not None:
            raise InvalidRequest("options_contradict", "--root: only with --out FILE.h5.")
        return None
    require_packages("h5py")
    try:
        named = [(p.absolute().relative_to(root.absolute()) if root else p) for p in photos]
    except ValueError as error:
        raise InvalidRequest("bad_names", f"Not every photo lies below --root: {error}.") from error
    names = [path.as_posix().lstrip("/") for path in named]
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InvalidRequest("bad_names", f"{twice[0]} is given twice: one name is one photo.")
    return names
