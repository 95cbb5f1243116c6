"""What is learned is real: against the untrained network, where it has never been."""

from __future__ import annotations

from pathlib import Path

from benchmarks.descriptors.train import measure_gain
from services.trainer import run
from services.trainer.arguments import build_arguments
from services.trainer.checkpointing import seed_everything
from services.trainer.model_factory import make_model
from services.trainer.resolve import resolve_device
from services.trainer.run_control import NullDisplay, StopRequest
from shared.datasets.open_dataset import open_evaluation_set
from shared.descriptors.vpr_models.checkpoint import load_checkpoint
from shared.synthetic_city.plan import CityOptions, make_plan
from shared.synthetic_city.write import write_city

SIDE = 64
EPOCHS = 8


def test_a_short_run_clearly_beats_the_untrained_network_on_held_out_places(
    tmp_path: Path,
) -> None:
    city = tmp_path / "city"
    write_city(make_plan(CityOptions(150, 2, 250, 0, 0, 0.0, 96, 72)), city)
    arguments = build_arguments(
        {
            "data_root": city,
            "default_root_dir": str(tmp_path),
            "run_name": "run",
            "accelerator": "cpu",
            "faiss_gpu": False,
            "backbone_arch": "resnet18",
            "pretrained": False,
            "layers_to_freeze": -1,
            "layers_to_crop": (3,),
            "agg_arch": "GeM",
            "loss_name": "MultiSimilarityLoss",
            "augmentation": "none",
            "image_size": SIDE,
            "batch_size": 16,
            "img_per_place": 4,
            "min_img_per_place": 4,
            "lr": 1e-3,
            "warmpup_steps": 20,
            "milestones": (),
            "max_epochs": EPOCHS,
            "check_val_every_n_epoch": EPOCHS,
            "num_workers": 0,
            "logger": "none",
        }
    )
    report = run.run(arguments, NullDisplay(), StopRequest())
    seed_everything(arguments.seed)
    untrained = make_model(arguments, NullDisplay(), resuming=False)
    trained = load_checkpoint(Path(report["best"]["path"])).model
    device, evaluation_set = resolve_device(arguments), open_evaluation_set(city)
    gain = measure_gain(untrained, trained, evaluation_set, SIDE, device, k=5)
    assert gain.queries == 250
    # The whole 95 % interval lies above nothing gained.
    assert gain.low > 0, gain
