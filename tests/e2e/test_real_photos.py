"""The main job on real photos, with the default extractor and its real weights, over HTTP."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.server import ServerProcess

pytestmark = pytest.mark.real_photos

# Found by eye: the same building, or the same street looked along.
TRUE_MATCH = {
    "q1.jpg": "db2.jpg",
    "q2.jpg": "db5.jpg",
    "q3.jpg": "db11.jpg",
    "q4.jpg": "db17.jpg",
    "q5.jpg": "db14.jpg",
}
# By day and from the same side. The others were taken at night, through a colour filter, or with
# most of the building hidden: EfficientNet-Lite0 ranks them lower.
EASY = ("q1.jpg", "q3.jpg")
# In q4, the building of another photo covers more of the view.
PROVEN = ("q1.jpg", "q2.jpg", "q3.jpg", "q5.jpg")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory, real_photos: Path) -> Iterator[ServerProcess]:
    home = tmp_path_factory.mktemp("real") / "home"
    with ServerProcess(home, extractor="efficientnet-lite0-vlad") as started:
        for photo in sorted((real_photos / "toy-places" / "database").glob("*.jpg")):
            started.indexed(photo.read_bytes(), photo.name)
        yield started


def test_real_places_are_found_before_and_after_the_map_has_its_own_vocabulary(
    server: ServerProcess, real_photos: Path
) -> None:
    foreign = ranks(server, real_photos, "foreign")
    job = server.client.post("/api/v1/vocabularies", json={}).json()
    done = server.finished(job["job_id"])
    assert done["state"] == "succeeded"
    assert done["result"] == {**done["result"], "photos": 17, "clusters": 64, "failed": 0}
    own = ranks(server, real_photos, "provisional")
    print("rank of the true place, foreign vocabulary:", foreign, "own:", own)
    for query in EASY:
        assert foreign[query] == 1
        assert own[query] == 1
    # 17 photos: by chance the five ranks would sum to 45.
    assert sum(foreign.values()) <= 25
    assert sum(own.values()) <= 25


def test_matching_points_prove_real_places(server: ServerProcess, real_photos: Path) -> None:
    for name in PROVEN:
        query = (real_photos / "toy-places" / "queries" / name).read_bytes()
        answer = server.ask(query, top_k=2, rerank=17, explain="true").json()
        best, second = answer["similar_images"]
        assert best["original_filename"] == TRUE_MATCH[name]
        assert best["inliers"] > 1.5 * second["inliers"]
        assert len(best["pairs"]) == best["inliers"]


def ranks(server: ServerProcess, real_photos: Path, vocabulary: str) -> dict[str, int]:
    """The rank (from 1) of each query's true place among all seventeen."""
    found = {}
    for name, match in TRUE_MATCH.items():
        query = (real_photos / "toy-places" / "queries" / name).read_bytes()
        answer = server.ask(query, top_k=17).json()
        assert answer["vocabulary"] == vocabulary
        names = [photo["original_filename"] for photo in answer["similar_images"]]
        assert len(names) == 17
        found[name] = names.index(match) + 1
    return found
