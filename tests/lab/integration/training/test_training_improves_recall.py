"""What is learned is real: against the untrained network, where it has never been."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from lightning.fabric import seed_everything

from lab.datasets.open_dataset import open_evaluation_set
from lab.evaluation.paired_runs import paired_differences
from lab.evaluation.query_clusters import cluster_queries
from lab.evaluation.ranking import evaluate_recall
from lab.evaluation.recall import compute_hits
from lab.training.arguments import build_arguments
from lab.training.describing import ModelDescriber
from lab.training.model_factory import make_model
from lab.training.resolve import make_fabric
from lab.training.run_control import NullDisplay
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from tests.lab.training_runs import run_arguments, train, write_tiny_places

pytestmark = pytest.mark.numerics

SIDE = 32
PLACES = 160
EPOCHS = 5
LIGHT = 0.7
"""The colour of the light dominates a random network's descriptors and says nothing of the place:
R@1 rises from a third to 85 % or more, at least 13 standard errors, whatever kernels compute it."""
MIN_GAIN = 0.2
"""BatchNorm's statistics alone, without a step of the optimizer, gain up to 0.1."""


def test_a_short_run_clearly_beats_the_untrained_network_on_held_out_places(
    tmp_path: Path,
) -> None:
    places = write_tiny_places(tmp_path / "places", places=PLACES, light=LIGHT)
    fields = run_arguments(
        places,
        tmp_path,
        layers_to_crop=[3],
        loss_name="MultiSimilarityLoss",
        augmentation="none",
        image_size=SIDE,
        batch_size=16,
        img_per_place=4,
        min_img_per_place=4,
        lr=3e-3,
        milestones=(),
        max_epochs=EPOCHS,
        check_val_every_n_epoch=EPOCHS,
    )
    report = train(fields)
    arguments = build_arguments(fields)
    seed_everything(arguments.seed, verbose=False)
    untrained = make_model(arguments, NullDisplay(), resuming=False)
    trained = load_checkpoint(Path(report["best"]["path"])).model
    device, evaluation_set = make_fabric(arguments).device, open_evaluation_set(places)
    found_first = []
    for model in (untrained, trained):
        describe = ModelDescriber(model.to(device), device, (SIDE, SIDE))
        ranked = evaluate_recall(describe, evaluation_set, ks=(1,)).ranked.indices
        hits = compute_hits(ranked, evaluation_set.positives)[:, :1]
        found_first.append(hits.astype(np.float64))
    assert len(evaluation_set.queries) == PLACES
    clusters = cluster_queries(evaluation_set.queries).labels
    (gain,) = paired_differences(found_first[1], found_first[0], clusters)
    # The whole 95 % interval lies above what no learning could gain.
    assert gain.low is not None
    assert gain.low > MIN_GAIN, gain
