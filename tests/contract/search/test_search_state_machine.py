"""Any order of publishing, deleting and merging gives the answers of brute force."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, assume
from hypothesis import settings as how
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)

from services.search.worker import SearchWorker
from shared.catalog.database.schema import migrate
from shared.catalog.database.session import Catalog
from shared.config.settings import Settings
from shared.storage import FolderStore
from shared.storage.chunks import decode_rows, manifest_key
from tests.contract.search.search_methods import always_by_codes
from tests.support.small_map import Reference, Rows, SmallMap, assert_answers, unit_rows


class AddDeleteMerge(RuleBasedStateMachine):
    """Any order of publishing, deleting, merging and following equals a brute-force model."""

    migrated: Path  # a catalog that every example copies: migrating takes longer than an example

    def __init__(self) -> None:
        super().__init__()
        self.seed = 0
        self.references: list[tuple[Reference, Rows]] = []

    @initialize()
    def open(self) -> None:
        self.folder = Path(tempfile.mkdtemp(prefix="pw-search-"))
        shutil.copy(self.migrated, self.folder / "catalog.sqlite")
        self.catalog = Catalog(f"sqlite:///{self.folder / 'catalog.sqlite'}")
        self.store = FolderStore(self.folder / "objects")
        self.places = SmallMap(self.catalog, self.store)
        self.worker = SearchWorker(
            self.catalog, self.store, Settings(), max_wait_seconds=300.0
        )  # compiles kernels

    def teardown(self) -> None:
        if hasattr(self, "folder"):
            self.catalog.close()
            shutil.rmtree(self.folder)

    @rule(count=st.integers(1, 4), dead=st.integers(0, 2))
    def add(self, count: int, dead: int) -> None:
        self.seed += 1
        self.places.add(unit_rows(self.seed, count), dead)

    @rule()
    def add_duplicates(self) -> None:
        self.places.add(np.repeat(unit_rows(0, 1), 2, axis=0))

    @rule(which=st.integers(0, 1000))
    def delete(self, which: int) -> None:
        assume(self.places.rows)
        photo_ids = sorted(self.places.rows)
        self.places.delete(photo_ids[which % len(photo_ids)])

    @rule()
    def merge(self) -> None:
        assert self.places.merge()

    @rule()
    def follow(self) -> None:
        self.worker.sync()

    @rule()
    def forget_everything(self) -> None:
        self.worker = SearchWorker(
            self.catalog, self.store, Settings(), max_wait_seconds=300.0
        )  # compiles kernels

    @rule(which=st.integers(0, 1000))
    def remember_a_reference(self, which: int) -> None:
        """Later merges supersede its chunk, and it must still mean this photo's descriptor."""
        assume(self.places.rows)
        photo_ids = sorted(self.places.rows)
        photo_id = photo_ids[which % len(photo_ids)]
        self.references.append((self.places.reference(photo_id), self.places.rows[photo_id]))

    @rule(k=st.integers(1, 30))
    def ask(self, k: int) -> None:
        vector = unit_rows(1000 + self.seed, 1)[0]
        self.check(self.places.query(vector), vector, k)
        self.check(self.places.query(unit_rows(0, 1)[0]), unit_rows(0, 1)[0], k)
        for reference, remembered in self.references:
            self.check(reference, remembered, k)

    def check(self, reference: Reference, vector: Rows, k: int) -> None:
        response = self.worker.search(self.places.request(reference, k=k))
        assert_answers(response, self.places.brute_force(vector, k))
        assert response.missing == ()

    @invariant()
    def rows_in_the_store_are_those_of_their_photos(self) -> None:
        if not hasattr(self, "places"):
            return
        references = self.places.references()
        stored = {key: decode_rows(self.store.get(key)) for key, _ in references.values()}
        for photo_id, row in self.places.rows.items():
            key, number = references[photo_id]
            np.testing.assert_array_equal(stored[key][number], row)
        for key in stored:
            assert self.store.head(manifest_key(key)) is not None


@pytest.fixture
def migrated(tmp_path: Path) -> None:
    path = tmp_path / "migrated.sqlite"
    catalog = Catalog(f"sqlite:///{path}")
    migrate(catalog)
    catalog.close()  # the last connection writes everything into the one file
    AddDeleteMerge.migrated = path


@pytest.mark.usefixtures("migrated")
@pytest.mark.parametrize("by", ["dense", "sign codes"])
def test_no_order_of_adding_deleting_and_merging_attaches_a_score_to_another_photo(
    by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if by == "sign codes":
        always_by_codes(monkeypatch)
    run_state_machine_as_test(
        AddDeleteMerge,
        settings=how(
            max_examples=8,
            stateful_step_count=15,
            suppress_health_check=list(HealthCheck),
        ),
    )
