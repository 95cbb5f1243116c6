"""Comparison of extractors on a map of this machine. Imports torch.

Photos are read from the catalog and the store, described here and ranked exactly; nothing is
stored. The figures are those of `MapEvaluation`: of labelled queries, else of own photos.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import Any, NamedTuple, cast
from uuid import UUID

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress
from rich.table import Column
from rich.text import Text
from sqlalchemy import select

from lab.cli.descriptors.extractors import photo_decoder, photo_describer
from lab.evaluation.ranking import check_finite
from services.cli.descriptors.load_extractor import load_extractor
from services.cli.descriptors.local_weights import inspect_weights, list_extractor_configs
from services.cli.environment import read_settings
from services.cli.output import (
    Table,
    format_percent,
    print_json,
    print_message,
    print_note,
    print_table,
    progress_bar,
    stage_bars,
)
from services.extractor.added_models import AddedModelLoader
from services.extractor.model_registry import DescriptorPipeline, ModelRegistry
from services.steward.map_evaluation import DECISIVE_CERTAINTY, MapEvaluation
from shared.catalog.database.schema import check_schema
from shared.catalog.database.session import Catalog
from shared.catalog.generations import active_generation
from shared.catalog.maps import Matching, decide_label_paths, get_map
from shared.catalog.models import list_registered_models
from shared.catalog.photos import Photo
from shared.catalog.tables import open_catalog
from shared.config.command_line import command_line
from shared.config.settings import Settings
from shared.descriptors.patches import fit_vocabulary, sample_photos
from shared.errors import Conflict, NotFound, PlacewiseError
from shared.evaluation.places.figures import share_with_interval
from shared.evaluation.places.levels import LevelScheme
from shared.extractor_config.configs import (
    DEFAULT_SAMPLE_PHOTOS,
    ExtractorConfig,
    get_extractor_config,
)
from shared.search_api.protocol import SearchBackend, SearchHit, SearchRequest, SearchResponse
from shared.storage import ObjectStore
from shared.storage.open_store import open_store

SEED = 0
RECALLS = {
    "labelled_queries": "labelled queries",
    "leave_one_out_without_sequence": "own photos, without those of their sequence",
    "leave_one_out": "own photos",
}
UNKNOWN = {"mean": None, "interval": None}


class Described(NamedTuple):
    """What is known of the photos' descriptors."""

    scores: NDArray[np.float32]
    """(photos, database photos) cosines"""
    cpu_seconds: float
    """of describing a photo, without decoding it"""
    dimension: int


class MapComparison:
    """Describes photos of a map with extractors, and evaluates them on their exact scores.

    Args:
        max_photos: Maximum number of photos of the map, and of labelled queries.

    Raises:
        NotFound: `map_not_found`.
        Conflict: `nothing_to_evaluate`.
    """

    def __init__(
        self,
        catalog: Catalog,
        store: ObjectStore,
        settings: Settings,
        map_name: str,
        max_photos: int,
        progress: Progress,
    ) -> None:
        self._store, self._settings = store, settings
        self._map_name, self._progress = map_name, progress
        with catalog.read() as session:
            map_ = get_map(session, map_name)
            generation = active_generation(session, map_.id)
            if generation is None:
                raise Conflict("nothing_to_evaluate", "The map has no described photo yet.")
            paths = decide_label_paths(session, map_)
            scheme = LevelScheme(labels_are_paths=paths, radii_m=settings.level_radii_m)
            added = list_registered_models(session)
        self._generation = generation
        self.evaluation = MapEvaluation(
            catalog,
            store,
            cast("SearchBackend", self),  # of which only `search` is called
            generation,
            settings.estimate_radius_m,
            scheme,
            Matching.OFF,
            lambda: self._progress.advance(self._bar),
            max_photos,
        )
        self._photos = [
            photo.photo_id for photo in (*self.evaluation.database.photos, *self.evaluation.queries)
        ]
        self._index_of = {photo_id: index for index, photo_id in enumerate(self._photos)}
        with catalog.read() as session:
            keys = select(Photo.id, Photo.object_key).where(Photo.id.in_(self._photos))
            self._keys = {row.id: row.object_key for row in session.execute(keys)}
        self._in_use = ModelRegistry(
            store, settings, AddedModelLoader(catalog, store, settings).load
        ).pipeline_of_generation(catalog, generation)
        configs = list_extractor_configs(settings)
        self.at_hand = [
            generation.extractor,
            *(config.name for config in configs if inspect_weights(config, settings).available),
            *((model.config or {}).get("extractor", model.name) for model in added),
        ]
        self.described: dict[str, Described] = {}

    def search(self, request: SearchRequest) -> SearchResponse:
        """Rank the map's photos by the scores of the extractor that is evaluated."""
        own = self._index_of[request.exclude[0]]  # the query itself
        order = np.argsort(-self._scores[own], kind="stable")
        hits = [
            SearchHit.model_construct(photo_id=self._photos[i], score=float(self._scores[own, i]))
            for i in order[order != own][: request.k].tolist()
        ]
        return SearchResponse(
            hits=tuple(hits),
            certificate="exhaustive",
            rows_scanned=len(order),
            rows_reranked=0,
            snapshot_version=request.min_version,
        )

    def compare(self, name: str) -> dict[str, Any]:
        """Evaluate an extractor.

        Returns:
            `extractor`; `queries` and their number; `recall_at_1`, `answered` and `right` with
            mean and interval; `cpu_seconds` and `bytes` a photo; and `switch`, the command that
            switches the map, None for the extractor in use.
        """
        config = self._config(name)
        described = self._describe(config)
        self._scores = described.scores
        self._bar = self._progress.add_task(f"{config.name}: searching", total=len(self._photos))
        figures = self.evaluation.evaluate(self.evaluation.database.photos).figures
        queries, count, recall = self._recall(figures)
        hits = round(recall * count)
        answers = (figures["places"] or {"answers": []})["answers"]
        answer = {each["certainty"]: each for each in answers}.get(DECISIVE_CERTAINTY, {})
        return {
            "extractor": config.name,
            "queries": f"{count} {queries}",
            "recall_at_1": share_with_interval([True] * hits + [False] * (count - hits)),
            "answered": answer.get("answered", UNKNOWN),
            "right": answer.get("precision", UNKNOWN),
            "cpu_seconds": described.cpu_seconds,
            "bytes": described.dimension * np.dtype(str(self._generation.row_type)).itemsize,
            "switch": self._switch_command(config),
        }

    def _config(self, name: str) -> ExtractorConfig:
        allowed = self._settings.allow_test_extractors
        return get_extractor_config(name, allow_test_extractors=allowed)

    def _recall(self, figures: dict[str, Any]) -> tuple[str, int, float]:
        """Return what was searched with, how often, and R@1."""
        for key, queries in RECALLS.items():
            if figures[key] and figures[key]["queries"]:
                return queries, figures[key]["queries"], figures[key]["R@1"]
        raise Conflict(
            "nothing_to_evaluate",
            f"No two photos of the map {self._map_name} show the same place. Index more, with "
            "coordinates or place labels, or labelled queries (placewise index DIR --role query).",
        )

    def _describe(self, config: ExtractorConfig) -> Described:
        if config.name not in self.described:
            is_in_use = config.name == self._generation.extractor
            pipeline = self._in_use if is_in_use else self._load(config)
            self.described[config.name] = self._describe_with(pipeline)
        return self.described[config.name]

    def _describe_with(self, pipeline: DescriptorPipeline) -> Described:
        extractor, centres, projection = pipeline.extractor, pipeline.centres, pipeline.projection
        describe = photo_describer(extractor, centres, self._settings, projection, self._read)
        described = list[Any]()
        report = stage_bars(self._progress, f"{extractor.config.name}: ")
        for batch in describe(self._photos):
            described.extend(batch)
            report("describing", len(described), len(self._photos))
        rows = np.stack(described)
        check_finite(rows, self._photos)
        scores = rows @ rows[: len(self.evaluation.database.photos)].T
        return Described(scores, describe.seconds / len(rows), rows.shape[1])

    def _load(self, config: ExtractorConfig) -> DescriptorPipeline:
        """Load an extractor, with the vocabulary in use, a shipped one, or one fitted here."""
        extractor = load_extractor(config, self._settings)
        if not config.needs_vocabulary:
            return DescriptorPipeline(extractor)
        if self._uses_own_vocabulary(config):
            return DescriptorPipeline(extractor, self._in_use.centres)
        if shipped := extractor.shipped_vocabulary():
            return DescriptorPipeline(extractor, shipped[0])
        number = len(self.evaluation.database.photos)
        numbers = sample_photos(number, DEFAULT_SAMPLE_PHOTOS, extractor.backbone.width, SEED)
        sample = [self._photos[number] for number in numbers]
        decoder = photo_decoder(extractor, self._settings, self._read)
        fitted = fit_vocabulary(
            extractor,
            (pixels for _, pixels in decoder.batches(sample, [])),
            len(sample),
            clusters=config.clusters,
            seed=SEED,
            on_progress=stage_bars(self._progress, f"{config.name}: vocabulary, "),
        )
        return DescriptorPipeline(extractor, fitted.centres)

    def _read(self, photo_id: UUID) -> bytes:
        return self._store.get(self._keys[photo_id])  # NotFound: deleted since

    def _uses_own_vocabulary(self, config: ExtractorConfig) -> bool:
        return config.needs_vocabulary and config.name == self._in_use.extractor.config.name

    def _switch_command(self, config: ExtractorConfig) -> str | None:
        if config.name == self._generation.extractor:
            return None
        home, options = self._settings.placewise_home, ["--extractor", config.name]
        if config.model is not None and config.model.file is not None:
            return command_line("models", "add", config.model.file, "--name", "NAME", home=home)
        if self._uses_own_vocabulary(config):
            options += ["--vocabulary", str(self._generation.vocabulary_id)]
        elif config.needs_vocabulary and config.shipped_vocabulary is None:
            # In another map, the vocabulary is fitted on its photos.
            return command_line("maps", "create", "NAME", *options, home=home)
        return command_line("maps", "switch", self._map_name, *options, home=home)


def compare_on_map(
    map_name: str | None,
    extractors: Sequence[str] | None,
    photos: int,
    as_json: bool,
) -> None:
    """Compare the extractors at hand, and others, on a map, and print the comparison.

    An extractor that can't be used is left out with a note. Raises as `MapComparison`.
    """
    settings = read_settings()
    if settings.database_url is None and not (settings.placewise_home / "catalog.sqlite").exists():
        raise NotFound(
            "map_not_found",
            f"There is no catalog in PLACEWISE_HOME ({settings.placewise_home}). Run the command "
            "where the catalog and the object store are.",
        )
    compared: list[dict[str, Any]] = []
    with (
        contextlib.closing(open_catalog(settings, "compare")) as catalog,
        progress_bar() as progress,
    ):
        check_schema(catalog)
        store = open_store(settings, exclusive=False)
        comparison = MapComparison(
            catalog, store, settings, map_name or "default", photos, progress
        )
        for name in dict.fromkeys([*comparison.at_hand, *(extractors or [])]):
            try:
                compared.append(comparison.compare(name))
            except PlacewiseError as error:
                if not compared:  # the extractor in use
                    raise
                print_note(f"{name} is left out: {error.detail}")
    compared.sort(key=lambda each: (-each["recall_at_1"]["mean"], each["cpu_seconds"]))
    if as_json:
        print_json(compared)
    else:
        _print_comparison(compared, len(comparison.evaluation.database.photos))


def _print_comparison(compared: Sequence[dict[str, Any]], photos: int) -> None:
    best = compared[0]
    names = ("R@1", "95 %", "answered", "right", "CPU ms", "bytes")
    table = Table(
        "extractor",
        *(Column(name, justify="right", no_wrap=True) for name in names),
        caption=f"{best['queries']}, among {photos} photos. Answered and right: at a certainty of "
        f"{DECISIVE_CERTAINTY:g}. CPU: describing a photo, without decoding.",
    )
    for each in compared:
        interval = each["recall_at_1"]["interval"]
        table.add_row(
            Text(each["extractor"]),
            format_percent(each["recall_at_1"]["mean"]),
            "-" if interval is None else f"{100 * interval[0]:.1f}-{100 * interval[1]:.1f}",
            format_percent(each["answered"]["mean"]),
            format_percent(each["right"]["mean"]),
            f"{1000 * each['cpu_seconds']:.1f}",
            str(each["bytes"]),
        )
    print_table(table)
    switch = best["switch"] and f"To switch to the best: {best['switch']}"
    print_message(switch or "The extractor in use is the best.")
