"""Recall gained by training over the untrained network, on places that were not trained on.

The network is trained in the school quarter of a generated city. It is evaluated in that city's map
quarter (other streets of the same style) and in another city with another catalogue (other walls,
colours, windows).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from services.trainer import run
from services.trainer.arguments import build_arguments
from services.trainer.checkpointing import seed_everything
from services.trainer.grid import GridPlan, PlannedRun, run_grid
from services.trainer.leaderboard import leaderboard
from services.trainer.model_describer import ModelDescriber
from services.trainer.model_factory import make_model
from services.trainer.resolve import Device
from services.trainer.run_control import NullDisplay, StopRequest
from shared.datasets.dataset import EvaluationSet
from shared.datasets.open_dataset import open_evaluation_set
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.descriptors.vpr_models.model import VprModel
from shared.evaluation.bootstrap import cluster_queries, paired_differences
from shared.evaluation.ranking import evaluate_recall
from shared.evaluation.retrieval_metrics import compute_hits
from shared.synthetic_city.plan import CityOptions, make_plan
from shared.synthetic_city.write import write_city

if TYPE_CHECKING:
    from rich.progress import Progress

PHOTO_SIZE = (160, 120)
"""width and height of the generated photos"""
VIEWS = 2
PLACES_PER_BATCH = 16
AGGREGATORS = (
    {"agg_arch": "AVG"},
    {"agg_arch": "GeM"},
    {"agg_arch": "ConvAP", "agg_config": {"out_channels": 64}},
)
LOSSES = ("MultiSimilarityLoss", "NTXentLoss")

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class RecallGain:
    """R@k from 0 to 1; the gain's 95 % interval is a paired bootstrap over clusters of queries."""

    untrained: float
    trained: float
    mean: float
    low: float
    high: float
    queries: int
    fingerprint: str

    def as_json(self) -> Json:
        return {name: getattr(self, name) for name in self.__slots__}


class BarDisplay(NullDisplay):
    """Display of a run that shows its progress as bars of the benchmark."""

    def __init__(self, progress: Progress) -> None:
        super().__init__()
        self._progress = progress
        self._bars: dict[str, Any] = {}

    def progress(self, what: str, done: int, total: int, note: str = "") -> None:
        if what not in self._bars:
            self._bars[what] = self._progress.add_task(what, total=total)
        self._progress.update(self._bars[what], completed=done, total=total)
        if done >= total:
            self._progress.remove_task(self._bars.pop(what))


def measure_learning(
    progress: Progress,
    folder: Path,
    places: int,
    epochs: int,
    image_size: int,
    workers: int,
    device: Device,
    seed: int,
) -> dict[str, RecallGain]:
    """Return the gain by evaluation set: `other streets` and `another catalogue`."""
    width, height = PHOTO_SIZE
    here = CityOptions(places, VIEWS, places, seed, 0, 0.0, width, height)
    elsewhere = replace(here, seed=seed + 1, catalogue_seed=1, train=False)
    sets = {
        "other streets": _draw_city(progress, here, folder / "here"),
        "another catalogue": _draw_city(progress, elsewhere, folder / "elsewhere"),
    }
    arguments = _training_arguments(
        folder / "here", folder / "runs", epochs, image_size, workers, device, seed
    )
    report = run.run(
        build_arguments({**arguments, "run_name": "gem"}), BarDisplay(progress), StopRequest()
    )
    trained = load_checkpoint(Path(report["best"]["path"])).model
    seed_everything(seed)
    untrained = make_model(build_arguments(arguments), NullDisplay(), resuming=False)
    return {
        name: measure_gain(untrained, trained, evaluation_set, image_size, device)
        for name, evaluation_set in sets.items()
    }


def measure_gain(
    untrained: VprModel,
    trained: VprModel,
    evaluation_set: EvaluationSet,
    image_size: int,
    device: Device,
    k: int = 1,
) -> RecallGain:
    """Return the difference of recall@k of two networks on the same queries."""
    within = []
    for model in (untrained, trained):
        describe = ModelDescriber(
            model.to(device.torch_device), device.torch_device, (image_size, image_size)
        )
        ranked = evaluate_recall(describe, evaluation_set, ks=(k,)).ranked.indices
        hits = compute_hits(ranked, evaluation_set.positives)[:, :k]
        within.append(np.any(hits, axis=1)[:, np.newaxis].astype(np.float64))
    (difference,) = paired_differences(
        within[1], within[0], cluster_queries(evaluation_set.queries).labels
    )
    assert difference.low is not None
    assert difference.high is not None
    return RecallGain(
        float(within[0].mean()),
        float(within[1].mean()),
        difference.mean,
        difference.low,
        difference.high,
        len(evaluation_set.queries),
        evaluation_set.fingerprint,
    )


def measure_grid(
    progress: Progress,
    folder: Path,
    epochs: int,
    image_size: int,
    workers: int,
    device: Device,
    seed: int,
) -> tuple[Table, list[dict[str, str]]]:
    """Train three aggregators x two losses on the city that `measure_learning` has generated."""
    arguments = _training_arguments(
        folder / "here", folder / "grid", epochs, image_size, workers, device, seed
    )
    del arguments["default_root_dir"]
    plan = GridPlan(
        tuple(
            PlannedRun(
                f"{aggregator['agg_arch']}-{loss}", {**arguments, **aggregator, "loss_name": loss}
            )
            for aggregator in AGGREGATORS
            for loss in LOSSES
        ),
        {},
    )
    outcomes = run_grid(
        plan, folder / "grid", BarDisplay(progress), StopRequest(), lambda done: None
    )
    rows = leaderboard(plan, outcomes)
    table = Table(*rows[0], title="six settings, other streets")
    for row in rows:
        table.add_row(*row.values())
    return table, rows


def _draw_city(progress: Progress, options: CityOptions, out: Path) -> EvaluationSet:
    plan = make_plan(options)
    bar = progress.add_task(f"drawing {out.name}", total=len(plan.photos))
    write_city(plan, out, lambda count: progress.advance(bar, count))
    return open_evaluation_set(out)


def _training_arguments(
    data_root: Path,
    out: Path,
    epochs: int,
    image_size: int,
    workers: int,
    device: Device,
    seed: int,
) -> Json:
    return {
        "data_root": str(data_root),
        "default_root_dir": str(out),
        "accelerator": device.accelerator,
        "faiss_gpu": False,
        "pretrained": False,
        "layers_to_freeze": -1,
        "agg_arch": "GeM",
        "augmentation": "none",  # light and weather already differ between the sessions
        "image_size": image_size,
        "batch_size": PLACES_PER_BATCH,
        "img_per_place": 4,
        "min_img_per_place": 4,
        "lr": 1e-3,
        "warmpup_steps": 20,
        "milestones": [epochs * 3 // 4, epochs * 9 // 10],
        "max_epochs": epochs,
        "check_val_every_n_epoch": max(1, epochs // 4),
        "num_workers": workers,
        "show_data_stats": False,
        "logger": "none",
        "seed": seed,
    }
