"""A server whose photos can be reconstructed, by local features that their pixels do not show."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import UUID

from shared.catalog.database.session import Catalog
from shared.storage import FolderStore
from tests.support.local_features import add_features
from tests.support.photos import photo_bytes
from tests.support.poses import ORIGIN, SIMILARITY
from tests.support.reconstructed_scene import ReconstructedScene
from tests.support.server import ServerProcess

SCENE = ReconstructedScene()
WRONG = 2  # the photo whose latitude is 100 m off
WRONG_DEGREES = 0.001
STRAY = "elsewhere.jpg"  # shows another scene


@contextmanager
def reconstructable_server(folder: Path) -> Iterator[ServerProcess]:
    """Yield a server with the photos of the scene, which are also in `folder/photos`, and STRAY."""
    (folder / "photos").mkdir()
    with ServerProcess(folder / "home") as server:
        features = {}
        centres = SIMILARITY.apply(SCENE.component.centres())
        for number, seen in enumerate(SCENE.features.values()):
            place = ORIGIN.to_geographic(centres[number])
            (folder / "photos" / f"{number}.jpg").write_bytes(photo_bytes(number))
            fields: dict[str, Any] = {
                "latitude": place.latitude + (WRONG_DEGREES if number == WRONG else 0),
                "longitude": place.longitude,
                "altitude": place.altitude_m,
            }
            features[UUID(server.indexed(photo_bytes(number), f"{number}.jpg", **fields))] = seen
        (stray,) = ReconstructedScene(photos=1, seed=1).features.values()
        features[UUID(server.indexed(photo_bytes(SCENE.photos), STRAY))] = stray
        server.kill()
        catalog = Catalog(f"sqlite:///{server.home / 'catalog.sqlite'}")
        add_features(catalog, FolderStore(server.home / "objects"), features)
        catalog.close()
        server.start()
        yield server
