"""Names of torch.hub extractors: pinned, canonical, and refused with what to write instead."""

from __future__ import annotations

import pytest

from shared.errors import Misconfigured
from shared.extractor_config.configs import get_extractor_config
from shared.extractor_config.names import (
    IMAGENET_MEAN,
    NetworkInput,
    TorchHubEntry,
    parse_torchhub_name,
)
from tests.support.hub import COMMIT

REPOSITORY = f"torchhub:gmberton/eigenplaces@{COMMIT}:get_trained_model"


def refusal(name: str, code: str) -> str:
    with pytest.raises(Misconfigured) as caught:
        parse_torchhub_name(name)
    assert caught.value.code == code
    return caught.value.detail


def test_a_repository_is_read_with_its_commit_entry_and_arguments() -> None:
    hub = parse_torchhub_name(f"{REPOSITORY}:fc_output_dim=512,backbone=ResNet18,pretrained=true")
    assert (hub.repository, hub.commit, hub.folder) == ("gmberton/eigenplaces", COMMIT, None)
    assert hub.entry == "get_trained_model"
    assert dict(hub.arguments) == {"backbone": "ResNet18", "fc_output_dim": 512, "pretrained": True}
    assert (hub.input.height, hub.input.width, hub.input.mean) == (224, 224, IMAGENET_MEAN)


def test_a_folder_is_parsed_with_its_preprocessing() -> None:
    hub = parse_torchhub_name(
        "torchhub:/models/mine/:entry:input.size=322x644,input.mean=0.5/0.5/0.25"
    )
    expected = NetworkInput(322, 644, mean=(0.5, 0.5, 0.25))
    assert hub == TorchHubEntry(None, None, "/models/mine", "entry", input=expected)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("7", 7),
        ("-7", -7),
        ("0.5", 0.5),
        ("1e-05", 1e-05),
        ("1e+20", 1e20),
        ("True", True),
        ("false", False),
        ("none", None),
        ("ResNet50", "ResNet50"),
        ("a:b", "a:b"),
    ],
)
def test_argument_types_follow_from_their_literals(written: str, value: object) -> None:
    hub = parse_torchhub_name(f"{REPOSITORY}:x={written}")
    assert hub.arguments == (("x", value),)
    assert type(hub.arguments[0][1]) is type(value)
    assert parse_torchhub_name(hub.name) == hub


@pytest.mark.parametrize(
    ("written", "canonical"),
    [
        ("b=2,a=1", "a=1,b=2"),
        ("a=01", "a=1"),
        ("input.size=224x224,input.mean=0.485/0.456/0.406,input.std=0.229/0.224/0.225", ""),
        ("zoom=1,input.size=0322x322", "input.size=322x322,zoom=1"),
        ("input.std=0.5/.5/0.50", "input.std=0.5/0.5/0.5"),
        ("input.mean=0.4850001/0.456/0.406", "input.mean=0.4850001/0.456/0.406"),
    ],
)
def test_equivalent_names_have_one_canonical_form(written: str, canonical: str) -> None:
    config = get_extractor_config(f"{REPOSITORY}:{written}", allow_test_extractors=False)
    assert config.name == f"{REPOSITORY}:{canonical}".rstrip(":")
    assert get_extractor_config(config.name, allow_test_extractors=False) == config


@pytest.mark.parametrize("pin", ["", "@main", "@v1.0", f"@{COMMIT[:39]}", f"@{COMMIT}0"])
def test_code_that_is_not_pinned_to_a_commit_is_refused_with_how_to_pin_it(pin: str) -> None:
    reported = refusal(f"torchhub:gmberton/eigenplaces{pin}:get_trained_model", "torchhub_unpinned")
    assert "torchhub:gmberton/eigenplaces@COMMIT:ENTRY" in reported
    assert "git ls-remote https://github.com/gmberton/eigenplaces HEAD" in reported


@pytest.mark.parametrize(
    "name",
    [
        "torchhub:",
        "torchhub:/models/mine",
        "torchhub::entry",
        "torchhub:/models/mine:not-a-name",
        "torchhub:/models/my own:entry",
        "torchhub:models:entry",
        "torchhub:../models:entry",
        "torchhub:a/b/c:entry",
        f"torchhub:a/b?c@{COMMIT}:entry",
        f"torchhub:/models/{'x' * 200}:entry",
    ],
)
def test_a_name_that_can_not_be_read_is_refused_with_how_it_is_written(name: str) -> None:
    assert "torchhub:OWNER/NAME@COMMIT:ENTRY" in refusal(name, "bad_torchhub_name")


@pytest.mark.parametrize(
    "options",
    [
        "",
        "a",
        "a=",
        "a=1,a=2",
        "a b=1",
        "a=1 2",
        "input.size=322",
        "input.size=8x8",
        "input.size=4096x10",
        "input.mean=0.5",
        "input.std=0/1/1",
        "input.mean=nan/0/0",
        "input.crop=1",
        "other.size=1",
    ],
)
def test_options_that_can_not_be_used_are_refused(options: str) -> None:
    assert "input.size, input.mean, input.std" in refusal(
        f"{REPOSITORY}:{options}", "bad_extractor_option"
    )


def test_networks_share_what_is_loaded_only_if_all_of_the_name_agrees() -> None:
    one = get_extractor_config(f"{REPOSITORY}:x=1", allow_test_extractors=False)
    same = get_extractor_config(f"{REPOSITORY}:x=01", allow_test_extractors=False)
    other = get_extractor_config(f"{REPOSITORY}:x=2", allow_test_extractors=False)
    assert one.backbone_key == same.backbone_key != other.backbone_key
    assert (one.dimension, one.needs_vocabulary) == (None, False)
