"""What refine remembers of landmarks: contents are those of a computation from nothing, whatever was remembered."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from isal import isal_zlib
from sqlalchemy import Connection, Engine, event, text

from semdb import threads
from semdb.database import copying_landmarks, landmark_parts, retry
from semdb.database.copying import copy_map
from semdb.database.ids import SharedIds
from semdb.database.landmark_parts import Arrays, LandmarkParts, pack, unpack
from semdb.database.refinements import forget
from semdb.database.store import Store, open_store
from semdb.refinement.landmark_step import LandmarkStep
from semdb.refinement.steps import LANDMARKS
from tests.integration.test_landmarks import contents, ingest, refine, table

SIZES = "SELECT kind, COUNT(*) FROM landmark_parts GROUP BY kind"


def sizes(store: Store) -> dict[str, int]:
    return {str(kind): int(str(number)) for kind, number in table(store, SIZES)}


def asked_for(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, bool]]:
    """Kinds of the parts that are asked for from now on, and whether they were there."""
    asked: list[tuple[str, bool]] = []
    get = LandmarkParts.get

    def noted(self: LandmarkParts, kind: str, name: str) -> object:
        found = get(self, kind, name)
        asked.append((kind, found is not None))
        return found

    monkeypatch.setattr(LandmarkParts, "get", noted)
    return asked


def changes_of(store: Store) -> list[str]:
    """What is written from now on."""
    written: list[str] = []

    def noted(_: object, __: object, statement: str, *___: object) -> None:
        if statement.startswith(("INSERT", "UPDATE", "DELETE")) and "refinements" not in statement:
            written.append(statement)

    event.listen(store.engine, "before_cursor_execute", noted)
    return written


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> dict[int, list[object]]:
    """What a computation from nothing gives, with the first keyframe and without."""
    found = {}
    for first in (0, 1):
        path: Path = tmp_path_factory.mktemp("reference") / "semdb.sqlite3"
        with open_store(f"sqlite:///{path}", create=True) as store:
            refine(store, ingest(store, range(first, 6), spoiled=True))
            found[first] = contents(store)
    return found


def test_only_what_changed_is_computed_and_contents_are_the_same(
    store: Store, reference: dict[int, list[object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    info = ingest(store, [5, 1, 2, 4], spoiled=True)
    refine(store, info)
    assert sizes(store)["lift"] == sizes(store)["grid"] == sizes(store)["look"] == 4
    ingest(store, [3, 0], spoiled=True)
    asked = asked_for(monkeypatch)
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: {0, 1, 2}, raising=False)
    refine(store, info)
    assert contents(store) == reference[0]
    lifts = [there for kind, there in asked if kind == "lift"]
    assert (lifts.count(False), sizes(store)["lift"]) == (2, 6)
    assert sum(there for kind, there in asked if kind == "surface") == 4
    # one is deleted: nothing of the others is lifted again, and what was remembered of it goes
    first = next(head.id for head in store.keyframe_heads(info.id) if head.frame_index == 0)
    store.delete_keyframes([first])
    asked.clear()
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda _: {0}, raising=False)
    refine(store, info)
    assert contents(store) == reference[1]
    assert all(there for kind, there in asked if kind in ("lift", "surface"))
    assert (sizes(store)["lift"], sizes(store)["grid"], sizes(store)["poses"]) == (5, 5, 1)
    # again, of the same keyframes: nothing is computed, and no image read
    asked.clear()
    forget(store.engine, info.id, LANDMARKS)
    written = changes_of(store)
    refine(store, info)
    assert contents(store) == reference[1]
    assert all(there for _, there in asked)
    assert {kind for kind, _ in asked} >= {"lift", "look", "thing"}
    assert not [statement for statement in written if "landmark" in statement]
    assert "grid" not in {kind for kind, _ in asked}
    refine(store, info, force=True)  # from nothing
    assert contents(store) == reference[1]
    store.delete_map(info.id)
    assert sizes(store) == {}


DAMAGES = ("x", "substr(data, 1, 40)", "substr(data, 1, length(data) - 3)")


@pytest.mark.parametrize(
    "kinds",
    ["'lift', 'look', 'thing', 'box', 'poses'", "'grid', 'thing', 'points'", "'surface', 'noise', 'thing', 'visit'"],
)
def test_damaged_parts_are_computed_anew(store: Store, reference: dict[int, list[object]], kinds: str) -> None:
    info = ingest(store, range(1, 6), spoiled=True)
    refine(store, info)
    for damage in DAMAGES:
        with store.engine.begin() as connection:
            value = ":other" if damage == "x" else damage
            change = text(f"UPDATE landmark_parts SET data = {value} WHERE kind IN ({kinds})")
            connection.execute(change, {"other": b"nothing that is a part"} if damage == "x" else {})
        forget(store.engine, info.id, LANDMARKS)
        refine(store, info)
        assert contents(store) == reference[1]


def test_of_a_keyframe_all_is_there_or_it_is_lifted_anew(
    store: Store, reference: dict[int, list[object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(landmark_parts, "MOST_WAITING", 0)  # what is large is stored as it comes
    info = ingest(store, range(1, 6), spoiled=True)
    refine(store, info)
    with store.engine.begin() as connection:
        gone = connection.execute(text("SELECT MIN(name) FROM landmark_parts WHERE kind = 'grid'")).scalar()
        connection.execute(text("DELETE FROM landmark_parts WHERE kind = 'grid' AND name = :name"), {"name": gone})
    stored: list[str] = []
    put = LandmarkParts.put

    def noted(self: LandmarkParts, kind: str, name: str, arrays: Arrays) -> None:
        stored.append(kind)
        put(self, kind, name, arrays)

    monkeypatch.setattr(LandmarkParts, "put", noted)
    forget(store.engine, info.id, LANDMARKS)
    refine(store, info)
    assert contents(store) == reference[1]
    assert stored == ["lift", "grid"]
    assert (sizes(store)["lift"], sizes(store)["grid"]) == (5, 5)
    with store.engine.begin() as connection:  # nothing more has room: all is computed anew, and once
        connection.execute(text("DELETE FROM landmark_parts"))
    monkeypatch.setattr(landmark_parts, "MOST_STORED", 0)
    for _ in range(2):
        stored.clear()
        forget(store.engine, info.id, LANDMARKS)
        refine(store, info)
        assert contents(store) == reference[1]
        assert (stored.count("lift"), sizes(store)) == (5, {})


def test_a_part_under_another_name_is_not_believed() -> None:
    arrays = {"a": np.arange(5), "b": np.zeros((2, 3), np.float32), "none": np.empty(0, np.bool_)}
    blob = pack("lift", "one", arrays)
    found = unpack("lift", "one", blob)
    assert found is not None
    assert all(np.array_equal(found[key], array) and found[key].dtype == array.dtype for key, array in arrays.items())
    assert unpack("lift", "two", blob) is None
    assert unpack("grid", "one", blob) is None
    rng = np.random.default_rng(0)
    for _ in range(200):
        spoiled = bytearray(blob)
        spoiled[int(rng.integers(len(spoiled)))] ^= int(rng.integers(1, 256))
        for damaged in (bytes(spoiled), blob[: int(rng.integers(len(blob)))]):
            found = unpack("lift", "one", damaged)  # what follows the content may be anything
            assert found is None or all(np.array_equal(found[key], array) for key, array in arrays.items())
    nothing = b"SDBL" + bytes(12) + isal_zlib.compress(b"", 1)
    assert unpack("lift", "one", nothing) is None
    assert unpack("lift", "one", None) is None
    assert unpack("lift", "one", "text") is None


def test_parts_do_not_leave_their_database(
    store: Store, tmp_path: Path, reference: dict[int, list[object]], monkeypatch: pytest.MonkeyPatch
) -> None:
    info = ingest(store, range(1, 6), spoiled=True)
    refine(store, info)

    def twice(engine: Engine, work: Callable[[Connection], object]) -> object:
        with engine.connect() as connection:  # a connection that is lost
            work(connection)
        return retry.write(engine, work)

    monkeypatch.setattr(copying_landmarks, "retry", SimpleNamespace(read=retry.read, write=twice))
    with open_store(f"sqlite:///{tmp_path}/copy.sqlite3", create=True) as other:
        for category in ("of the copy alone", "and another one"):  # ids are others there
            SharedIds(other.engine).categories([category])
        copy_map(store.engine, info.id, other.engine, "copy")
        copied = other.find_map("copy")
        assert contents(other) == reference[1]
        assert other.completion_of(copied.id) == other.map_state(copied.id)
        assert sizes(other) == {}
        found = LandmarkStep().compute(other, copied.id, lambda *_: None)
        assert len(found.landmarks) == len(table(other, "SELECT id FROM landmarks"))
