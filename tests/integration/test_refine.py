"""`semdb refine` on both servers: what it computes, when that is out of date, and that order and ids do not matter."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import Connection, text
from sqlalchemy.exc import IntegrityError

from semdb.database.records import ClassConfusion, MapInfo
from semdb.database.refinements import CLASSES
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.geometry import invert_pose, transform_points
from semdb.refinement import run as refine
from semdb.refinement.class_step import ClassStep
from semdb.refinement.run import StepResult
from semdb.types import Description, ObjectGeometry
from tests.database_samples import MODELS, description, plan, pose, record


def refine_map(store: Store, info: MapInfo, *, force: bool = False) -> list[StepResult]:
    """The step of classes alone."""
    return refine.refine_map(store, info, kinds=[CLASSES], force=force)


SOFA, LAMP = (0.5, 1.0, 2.0), (-1.0, 0.5, 2.5)


def seen_from(frame_index: int, sofa: str) -> Description:
    """A view of a sofa, under some name, and of a lamp that is always one."""
    made = description(frame_index, [sofa, "potted plant"])
    places = transform_points(invert_pose(pose(frame_index)), np.array([SOFA, LAMP]))
    geometry = tuple(ObjectGeometry(900, place, np.full(3, 0.5)) for place in places)
    return replace(made, geometry=geometry)


def ingest(store: Store, name: str, order: Sequence[int]) -> tuple[MapInfo, int]:
    """Ten views in some order; every third one shows a bed where the others show a couch."""
    map_id = store.ensure_map(name)
    planned = store.plan_recording(map_id, plan("visit", range(10)), MODELS)
    for index in order:
        store.write_keyframe(planned.recording_id, record(index, seen_from(index, "couch" if index % 3 else "bed")))
    return store.find_map(name), planned.recording_id


def rows_of(store: Store, info: MapInfo) -> list[tuple[object, ...]]:
    """The rows as they are, but for ids."""
    query = text(
        "SELECT a.name, b.name, c.pairs, c.weight FROM class_confusions c JOIN categories a ON a.id = c.category_id "
        "JOIN categories b ON b.id = c.other_category_id WHERE c.map_id = :map ORDER BY a.name, b.name"
    )
    with store.engine.connect() as connection:
        return [tuple(row) for row in connection.execute(query, {"map": info.id})]


def test_classes_that_lie_at_one_place_are_confused(store: Store) -> None:
    info, _ = ingest(store, "room", range(10))
    (result,) = refine_map(store, info)
    assert (result.kind, result.rows, result.computed, result.current) == ("classes", 2, True, True)
    # 4 views call it a bed, 6 a couch: a bed has 3 beds and 6 couches beside it, a couch 5 couches and 4 beds
    assert store.class_confusions(info.id) == [
        ClassConfusion("bed", "couch", 24, 24 * 1_000_000 // (12 + 24 + 4)),
        ClassConfusion("couch", "bed", 24, 24 * 1_000_000 // (30 + 24 + 4)),
    ]
    (again,) = refine_map(store, info)
    assert (again.rows, again.computed, again.current) == (2, False, True)
    assert refine_map(store, info, force=True)[0].computed


def test_order_of_ingest_and_ids_do_not_matter(store: Store) -> None:
    first, _ = ingest(store, "first", range(10))
    second, _ = ingest(store, "second", [7, 2, 9, 0, 4, 1, 8, 3, 6, 5])
    refine_map(store, second)
    refine_map(store, first)
    assert rows_of(store, first) == rows_of(store, second)
    assert len(rows_of(store, first)) == 2


def test_it_is_out_of_date_after_ingest_deletion_and_a_corrected_pose(store: Store) -> None:
    info, recording_id = ingest(store, "room", range(9))
    other, _ = ingest(store, "other", range(10))
    refine_map(store, info)
    refine_map(store, other)

    def current() -> bool:
        (known,) = store.refinements(info.id)
        assert store.refinements(other.id)[0].current
        return known.current

    assert current()
    store.write_keyframe(recording_id, record(9, seen_from(9, "couch")))
    assert not current()
    assert refine_map(store, info)[0].computed
    assert current()
    ids, _ = store.poses(info.id)
    with store.engine.begin() as connection:
        connection.execute(text("DELETE FROM keyframe_changes"))  # a trimmed log changes nothing
    assert current()
    store.delete_keyframes([ids[4]])
    assert not current()
    refine_map(store, info)
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE keyframes SET tx = tx + 0.01 WHERE id = :id"), {"id": ids[0]})
    assert not current()
    assert [(item.map, item.kind) for item in store.refinements()] == [("room", "classes"), ("other", "classes")]


def test_other_parameters_are_computed_anew(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    info, _ = ingest(store, "room", range(10))
    refine_map(store, info)
    strict = ClassStep(replace(ClassStep().options, minimum_weight=0.5))
    monkeypatch.setattr(refine, "STEPS", (strict,))
    (result,) = refine_map(store, info)
    assert result.computed
    assert [(row[0], row[1]) for row in rows_of(store, info)] == [("bed", "couch")]


def test_a_map_that_changes_meanwhile_is_read_again(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    info, recording_id = ingest(store, "room", range(8))
    late = iter([8, 9])

    class Slow(ClassStep):
        """Another process stores a keyframe while the first two attempts compute."""

        def compute(self, store: Store, map_id: int, progress: object) -> list[ClassConfusion]:
            found = super().compute(store, map_id, progress)  # type: ignore[arg-type]
            for index in late:
                store.write_keyframe(recording_id, record(index, seen_from(index, "couch" if index % 3 else "bed")))
                break
            return found

    monkeypatch.setattr(refine, "STEPS", (Slow(),))
    (result,) = refine_map(store, info)
    assert result.current
    assert rows_of(store, info)[0] == ("bed", "couch", 24, 600_000)


def test_two_at_once_leave_one_result(database_url: str, store: Store) -> None:
    info, _ = ingest(store, "room", range(10))
    failures: list[BaseException] = []
    start = threading.Barrier(4)

    def work() -> None:
        try:
            with open_store(database_url) as own:
                start.wait()
                refine_map(own, info, force=True)
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert len(rows_of(store, info)) == 2
    assert store.refinements(info.id)[0].current


def test_a_map_or_keyframe_that_goes_meanwhile(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    info, _ = ingest(store, "room", range(4))

    class Refused(ClassStep):
        def write(self, connection: Connection, map_id: int, result: object) -> int:
            raise IntegrityError("INSERT", {}, ValueError("there is no such keyframe"))

    monkeypatch.setattr(refine, "STEPS", (Refused(),))
    with pytest.raises(DatabaseError, match="kept changing"):
        refine_map(store, info)
    assert store.refinements(info.id) == []
    monkeypatch.undo()
    store.delete_map(info.id)
    with pytest.raises(NotFoundError, match="deleted while"):
        refine_map(store, info)
    with pytest.raises(UsageError, match="known are"):
        refine.refine_map(store, info, kinds=["walls"])


def test_rows_go_with_their_map(store: Store) -> None:
    info, _ = ingest(store, "room", range(10))
    refine_map(store, info)
    store.delete_map(info.id)
    assert rows_of(store, info) == []
    assert store.refinements() == []
