"""One suite for every server: estimated poses that a plan brings, links, moves that are done whole or not at all."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import event, select, text

from semdb.database import items, schema, tables
from semdb.database.copying import copy_map
from semdb.database.engine import make_engine
from semdb.database.links import list_links, load_covariances
from semdb.database.moving import move
from semdb.database.pose_records import (
    Link,
    LinkKind,
    LinkState,
    Move,
    MovedRecording,
    OperationKind,
    PoseSource,
    World,
)
from semdb.database.pose_sources import load_planned_poses, recording_poses, turned
from semdb.database.records import ChangeKind
from semdb.database.store import Store, open_store
from semdb.database.undoing import list_operations, undo
from semdb.errors import DatabaseError, NotFoundError, ProvenanceError, UsageError
from semdb.localization.index import IndexSource, MapIndex
from semdb.localization.sources import SqlSource
from semdb.types import FloatArray
from tests.database_samples import MODELS, OTHER_MODELS, description, fill, plan, pose, record
from tests.integration.comparison import REMAINING, rows_per_table
from tests.integration.test_index import EXACT, assert_same
from tests.pose_samples import FRAMES, fill_estimated, information, link, planned_poses, write

MOTION = pose(77)


def wanted(store: Store, map_id: int, recording_id: int, source: int, *, name: str = "own", links: bool = True) -> Move:
    """The move of a whole recording by `MOTION`, with a link to the map's first keyframe."""
    before = poses_of(store, source, recording_id)
    after = {key: MOTION @ value for key, value in before.items()}
    first, theirs = min(before), min(store.keyframe_ids(map_id), default=0)
    found = (link(theirs, first, LinkKind.SESSION),) if links and theirs != first else ()
    return Move(
        OperationKind.ALIGN,
        map_id,
        before,
        after,
        (MovedRecording(recording_id, source, name, MOTION),),
        found,
        {key: information(key) / 1e6 for key in before},
        {"agreeing": len(before)},
    )


def poses_of(store: Store, map_id: int, recording_id: int) -> dict[int, FloatArray]:
    own = {head.id for head in store.keyframe_heads(map_id, recording_id)}
    ids, poses = store.poses(map_id)
    return {key: value for key, value in zip(ids, poses, strict=True) if key in own}


def everything(store: Store) -> dict[str, list[tuple[object, ...]]]:
    with store.engine.connect() as connection:
        return {
            table.name: sorted(map(tuple, connection.execute(select(table))), key=repr)
            for table in tables.metadata.sorted_tables
        }


def test_estimated_poses_come_with_the_plan(store: Store) -> None:
    before = rows_per_table(store)
    map_id, recording_id, ids = fill_estimated(store)
    known = recording_poses(store.engine, recording_id)
    assert (known.source, known.world, known.upright) == (PoseSource.ESTIMATED, World.FIRST_KEYFRAME, True)
    np.testing.assert_array_equal(known.map_from_recording, np.eye(4))
    planned = load_planned_poses(store.engine, recording_id)
    assert list(planned) == list(FRAMES)
    np.testing.assert_allclose(planned[7], pose(107), atol=1e-12)
    covariances = load_covariances(store.engine, ids)
    assert list(covariances) == ids
    np.testing.assert_allclose(covariances[ids[2]], information(7) / 1e6, rtol=1e-12)
    links = list_links(store.engine, map_id)
    assert [(one.first, one.second, one.kind, one.state) for one in links] == [
        (ids[0], ids[1], LinkKind.ODOMETRY, LinkState.ACCEPTED),
        (ids[0], ids[4], LinkKind.LOOP, LinkState.ACCEPTED),
        (ids[1], ids[2], LinkKind.ODOMETRY, LinkState.ACCEPTED),
        (ids[1], ids[4], LinkKind.LOOP, LinkState.CONTRADICTED),
        (ids[2], ids[3], LinkKind.ODOMETRY, LinkState.ACCEPTED),
        (ids[3], ids[4], LinkKind.ODOMETRY, LinkState.ACCEPTED),
    ]
    np.testing.assert_allclose(links[1].first_from_second, pose(-20), atol=1e-12)
    np.testing.assert_allclose(links[1].information, information(20), rtol=1e-12)
    assert (links[3].inliers, links[3].reason, links[3].provenance) == (40, "contradicts 41 of 42", "made up")
    assert [one.kind for one in list_links(store.engine, odometry=False)] == [LinkKind.LOOP] * 2
    store.finish_recording(recording_id)  # again: nothing is there twice
    assert len(list_links(store.engine)) == 6
    with store.engine.connect() as connection:
        view = list(connection.execute(text("SELECT * FROM keyframe_links WHERE state = 'contradicted'")).mappings())
    assert [(row["map"], row["recording"], row["frame_index"], row["other_frame_index"]) for row in view] == [
        ("estimated", "own", 3, 20)
    ]
    assert view[0]["distance_squared"] == pytest.approx(float((links[3].first_from_second[:3, 3] ** 2).sum()))

    store.delete_keyframes(ids[4:])
    assert len(list_links(store.engine)) == 3
    store.delete_map(map_id)
    after = rows_per_table(store)
    assert {name for name, count in after.items() if count != before[name]} <= REMAINING


def test_frames_are_never_mixed_silently(store: Store) -> None:
    fill(store)
    before = everything(store)
    with pytest.raises(UsageError, match=r"'room' holds the recording 'first visit' already.*--align"):
        fill_estimated(store, "room")
    fill_estimated(store, "mine")
    with pytest.raises(UsageError, match=r"frame of the map 'mine' is that of the estimated poses of 'own'.*--align"):
        fill(store, "mine", "second visit")
    with pytest.raises(UsageError, match="stored already with estimated poses: ask for these"):
        store.plan_recording(store.ensure_map("mine"), plan("own", FRAMES), MODELS)
    with pytest.raises(UsageError, match="stored already with recorded poses: ask for these"):
        store.plan_recording(
            store.ensure_map("room"), replace(plan("first visit", FRAMES), poses=planned_poses()), MODELS
        )
    store.delete_map(store.find_map("mine").id)
    after = everything(store)
    assert {name for name in before if before[name] != after[name]} <= REMAINING


def test_a_recording_moves_into_a_map_and_back(store: Store, tmp_path: Path) -> None:
    map_id, _, theirs = fill(store)
    source, recording_id, ids = fill_estimated(store)
    before = everything(store)
    with (
        MapIndex.open(store, map_id, tmp_path, options=EXACT) as there,
        MapIndex.open(store, source, tmp_path, options=EXACT) as here,
    ):
        pairs = [(IndexSource(index), SqlSource(store, key)) for index, key in ((there, map_id), (here, source))]
        for _, sql in pairs:
            sql.refresh()
        plan_of_it = wanted(store, map_id, recording_id, source)
        operation = move(store.engine, plan_of_it)
        assert store.keyframe_ids(source) == []
        assert store.keyframe_ids(map_id) == sorted([*theirs, *ids])
        stored = poses_of(store, map_id, recording_id)
        for key in ids:
            np.testing.assert_allclose(stored[key], plan_of_it.after[key], atol=1e-12)
            np.testing.assert_allclose(load_covariances(store.engine, [key])[key], information(key) / 1e6, rtol=1e-9)
        known = recording_poses(store.engine, recording_id)
        assert (known.source, known.world) == (PoseSource.ESTIMATED, World.ALIGNED)
        np.testing.assert_allclose(known.map_from_recording, MOTION, atol=1e-12)
        for key in (map_id, source):
            moved = [c.keyframe_id for c in store.changes_since(key, 0) if c.kind is ChangeKind.MOVED]
            assert moved == ids
        for index, sql in pairs:
            changes = index.refresh(), sql.refresh()
            assert changes[0].gone == changes[1].gone == frozenset(ids)
            if sql.keyframe_count():
                assert_same(index, sql, seed=3)
            assert index.keyframe_count() == sql.keyframe_count()
        assert pairs[0][0].keyframe_count() == len(theirs) + len(ids)
        assert pairs[1][0].keyframe_count() == 0
        [session] = [one for one in list_links(store.engine, map_id) if one.kind is LinkKind.SESSION]
        assert (session.first, session.second) == (min(theirs), min(ids))
        with store.engine.connect() as connection:
            revised = list(connection.execute(select(tables.pose_revisions)))
        assert [(row.keyframe_id, row.operation_id) for row in sorted(revised)] == [(key, operation) for key in ids]
        [noted] = list_operations(store.engine, recording_id=recording_id)
        assert (noted.from_map, noted.from_name, noted.undone_at) == ("estimated", "own", None)
        assert noted.parameters["agreeing"] == 5

        assert undo(store.engine, noted) == len(ids)
        for index, sql in pairs:
            index.refresh(), sql.refresh()
            assert_same(index, sql, seed=4)
        assert pairs[1][0].keyframe_count() == len(ids)
    after = everything(store)
    changed = {name for name in before if before[name] != after[name]}
    assert changed <= {"keyframe_changes", "pose_operations", "pose_revisions", "keyframes", "planned_poses",
                       "pose_covariances", "pose_sources"}  # fmt: skip
    for name in ("keyframes", "pose_sources"):  # to the last digit but one
        for one, two in zip(before[name], after[name], strict=True):
            assert [v for v in one if not isinstance(v, float)] == [v for v in two if not isinstance(v, float)]
            np.testing.assert_allclose(
                [v for v in one if isinstance(v, float)], [v for v in two if isinstance(v, float)], atol=1e-12
            )
    assert sorted(load_covariances(store.engine, ids)) == ids
    [noted] = list_operations(store.engine, map_id)
    assert noted.undone_at is not None
    with pytest.raises(UsageError, match="was taken back already"):
        undo(store.engine, noted)


def test_the_map_that_a_recording_came_from_is_made_again(store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, ids = fill_estimated(store)
    move(store.engine, wanted(store, map_id, recording_id, source))
    store.delete_map(source)
    [noted] = list_operations(store.engine, map_id)
    undo(store.engine, noted)
    found = store.find_map("estimated")
    assert store.keyframe_ids(found.id) == ids
    assert store.map_models(found.id) == MODELS


def test_nothing_is_taken_back_into_another_frame(store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, ids = fill_estimated(store)
    move(store.engine, wanted(store, map_id, recording_id, source))
    fill(store, "estimated", "second visit")  # the map was empty, so it may have another frame now
    [noted] = list_operations(store.engine, map_id)
    before = everything(store)
    with pytest.raises(
        UsageError, match=r"the map 'estimated' .* holds 'second visit' by now, which has another frame"
    ):
        undo(store.engine, noted)
    assert everything(store) == before
    store.delete_recording(next(one.recording_id for one in store.status(source)))
    assert undo(store.engine, noted) == len(ids)
    assert store.keyframe_ids(source) == ids


def test_a_link_to_a_keyframe_that_is_gone_is_told_as_that(store: Store) -> None:
    map_id, _, theirs = fill(store)
    source, recording_id, _ = fill_estimated(store)
    stale = wanted(store, map_id, recording_id, source)
    store.delete_keyframes([min(theirs)])
    before = everything(store)
    with pytest.raises(DatabaseError, match=f"keyframe {min(theirs)} was deleted meanwhile, nothing is changed"):
        move(store.engine, stale)
    assert everything(store) == before


def test_what_is_stored_late_goes_along(store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, ids = fill_estimated(store, leave=2)
    move(store.engine, wanted(store, map_id, recording_id, source))
    late = write(store, recording_id, 12)  # through a writer that remembers the other map
    assert late in store.keyframe_ids(map_id)
    np.testing.assert_allclose(poses_of(store, map_id, recording_id)[late], MOTION @ pose(112), atol=1e-9)
    found = load_covariances(store.engine, [late])[late]
    np.testing.assert_allclose(found, turned(information(12) / 1e6, MOTION), rtol=1e-6, atol=1e-12)
    with store.engine.connect() as connection:
        c = tables.keyframe_categories.c
        assert set(connection.execute(select(c.map_id).where(c.keyframe_id == late)).scalars()) == {map_id}
    [noted] = list_operations(store.engine, map_id)
    assert undo(store.engine, noted) == len(ids) + 1
    np.testing.assert_allclose(poses_of(store, source, recording_id)[late], pose(112), atol=1e-9)
    last = write(store, recording_id, 20)
    np.testing.assert_allclose(poses_of(store, source, recording_id)[last], pose(120), atol=1e-12)


@pytest.mark.parametrize("back", [False, True])
def test_a_keyframe_that_is_stored_after_a_move_has_begun_to_read(any_server_url: str, back: bool) -> None:
    """Its transaction does not see it, but the move has to: else it stays where it was in a recording that moved.

    (Writers of SQLite wait for each other.)
    """
    engine = make_engine(any_server_url)
    schema.upgrade(engine)
    engine.dispose()
    with open_store(any_server_url) as store, open_store(any_server_url) as other:
        map_id, _, _ = fill(store)
        source, recording_id, _ = fill_estimated(store, leave=1)
        late = replace(record(20, description(320)), world_from_camera=pose(120))
        if back:
            move(store.engine, wanted(store, map_id, recording_id, source))
            [operation] = list_operations(store.engine, map_id)
            work = partial(undo, store.engine, operation)
        else:
            work = partial(move, store.engine, wanted(store, map_id, recording_id, source))
        stored: list[int] = []

        def store_late(_c: object, _u: object, statement: str, *_: object) -> None:
            if statement.startswith("UPDATE ingest_items") and not stored:
                stored.append(0)
                stored[0] = other.write_keyframe(recording_id, late).keyframe_id

        event.listen(store.engine, "before_cursor_execute", store_late)
        try:
            with pytest.raises(DatabaseError, match="stored or deleted meanwhile"):
                work()
        finally:
            event.remove(store.engine, "before_cursor_execute", store_late)
        expected = MOTION @ pose(120) if back else pose(120)
        np.testing.assert_allclose(
            poses_of(store, map_id if back else source, recording_id)[stored[0]], expected, atol=1e-9
        )
        if back:
            work()
            np.testing.assert_allclose(poses_of(store, source, recording_id)[stored[0]], pose(120), atol=1e-9)


def test_a_move_that_cannot_be_changes_nothing(store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, ids = fill_estimated(store, name="first visit")
    other = store.ensure_map("other models")
    store.plan_recording(other, plan("x", (1,)), OTHER_MODELS)
    before = everything(store)
    good = wanted(store, map_id, recording_id, source, name="second visit")
    clash = wanted(store, map_id, recording_id, source, name="first visit")
    with pytest.raises(UsageError, match=r"'room' has a recording 'first visit' already: give this one .*--name"):
        move(store.engine, clash)
    with pytest.raises(ProvenanceError, match="'other models' is described by the encoder"):
        move(store.engine, replace(good, map_id=other, links=()))
    shifted = {key: value.copy() for key, value in good.before.items()}
    shifted[ids[1]][0, 3] += 1e-3
    with pytest.raises(DatabaseError, match=f"keyframe {ids[1]} was deleted or moved meanwhile, nothing is changed"):
        move(store.engine, replace(good, before=shifted))
    few = {key: good.before[key] for key in ids[1:]}
    with pytest.raises(DatabaseError, match="were stored or deleted meanwhile, nothing is changed"):
        move(store.engine, replace(good, before=few, after={key: good.after[key] for key in few}))
    with pytest.raises(DatabaseError, match="keyframes came into the map 'room', or left it, meanwhile"):
        move(store.engine, replace(good, counted=4))
    with pytest.raises(NotFoundError, match="there is no map with the id 9999"):
        move(store.engine, replace(good, map_id=9999))
    wild = {**good.after, ids[0]: np.full((4, 4), np.nan)}
    with pytest.raises(UsageError, match="finite 4x4 pose"):
        move(store.engine, replace(good, after=wild))
    assert everything(store) == before


def test_a_recording_that_is_being_ingested_stays(store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, _ = fill_estimated(store, leave=1)
    items.claim(store.engine, recording_id, "someone", limit=1)
    with pytest.raises(UsageError, match="'own' is being ingested: run it again when that is done"):
        move(store.engine, wanted(store, map_id, recording_id, source))
    items.release(store.engine, recording_id, "someone")
    move(store.engine, wanted(store, map_id, recording_id, source))


def test_later_moves_are_taken_back_first(store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, ids = fill_estimated(store)
    move(store.engine, wanted(store, map_id, recording_id, source))
    before = poses_of(store, map_id, recording_id)
    after = {key: MOTION @ value for key, value in before.items()}
    move(store.engine, Move(OperationKind.REFINE, map_id, before, after))
    second, first = list_operations(store.engine, map_id)
    assert (second.kind, second.recording_id) == (OperationKind.REFINE, None)
    with pytest.raises(
        UsageError, match=r"was moved again after operation .*take the later one back first: semdb align --undo --map "
    ):
        undo(store.engine, first)
    assert undo(store.engine, second) == len(ids)
    assert undo(store.engine, first) == len(ids)
    assert store.keyframe_ids(source) == ids


def test_what_was_laid_on_moved_keyframes_is_taken_back_first(store: Store) -> None:
    map_id, first_id, _ = fill(store)
    before = poses_of(store, map_id, first_id)
    move(store.engine, Move(OperationKind.REFINE, map_id, before, {key: MOTION @ one for key, one in before.items()}))
    source, recording_id, ids = fill_estimated(store)
    move(store.engine, wanted(store, map_id, recording_id, source))
    later, first = list_operations(store.engine, map_id)
    as_it_is = everything(store)
    with pytest.raises(
        UsageError, match=rf"'own' \(operation {later.id}\) was laid on the keyframes of operation {first.id} since"
    ):
        undo(store.engine, first)
    assert everything(store) == as_it_is
    assert undo(store.engine, later) == len(ids)
    assert undo(store.engine, first) == len(before)
    assert poses_of(store, map_id, first_id).keys() == before.keys()


def test_links_are_copied_with_their_map(store: Store, tmp_path: Path) -> None:
    map_id, recording_id, ids = fill_estimated(store)
    move(store.engine, Move(OperationKind.REFINE, map_id, *[poses_of(store, map_id, recording_id)] * 2))
    with open_store(f"sqlite:///{tmp_path / 'copy.sqlite3'}", create=True) as copy:
        for _ in range(2):  # again: nothing is there twice
            copy_map(store.engine, map_id, copy.engine, "copied")
        assert [(one.first, one.second, one.kind) for one in list_links(copy.engine)] == [
            (ids.index(one.first) + 1, ids.index(one.second) + 1, one.kind) for one in list_links(store.engine)
        ]
        assert recording_poses(copy.engine, 1).source is PoseSource.ESTIMATED
        assert rows_per_table(copy)["planned_poses"] == 5
        assert rows_per_table(copy)["pose_operations"] == 0


def state_of(store: Store) -> str:
    """All that a move changes, in a text: poses to a nanometre."""
    rows = everything(store)
    names = ("maps", "recordings", "keyframes", "keyframe_categories", "loop_closures", "keyframe_changes",
             "pose_sources", "pose_covariances", "pose_operations", "pose_revisions")  # fmt: skip
    return json.dumps({name: rows[name] for name in names}, default=repr, sort_keys=True)


def killed_at(url: str, statement: int, map_id: int, recording_id: int, source: int) -> bool:
    """A process that moves the recording is killed before its n-th statement; whether it came that far."""
    child = os.fork()
    if child == 0:
        with open_store(url) as store:
            plan_of_it, seen = wanted(store, map_id, recording_id, source), [0]

            @event.listens_for(store.engine, "before_cursor_execute")
            def count(*_: object) -> None:
                seen[0] += 1
                if seen[0] == statement:
                    os._exit(3)

            move(store.engine, plan_of_it)
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 3


def test_killed_anywhere_it_is_as_it_was(database_url: str, store: Store) -> None:
    map_id, _, _ = fill(store)
    source, recording_id, ids = fill_estimated(store)
    store.close()  # no connection is shared with a child
    with open_store(database_url) as looked:
        before = state_of(looked)
    statement = 0
    while True:
        statement += 1
        if not killed_at(database_url, statement, map_id, recording_id, source):
            break
        with open_store(database_url) as looked:
            assert state_of(looked) == before, f"statement {statement}"
    assert statement > 15
    with open_store(database_url) as looked:
        assert set(ids) <= set(looked.keyframe_ids(map_id))
        assert looked.keyframe_ids(source) == []


def test_a_link_that_is_none_is_refused(store: Store) -> None:
    map_id, _, ids = fill_estimated(store)
    before = poses_of(store, map_id, 1)
    bad = Link(ids[0], ids[1], LinkKind.LOOP, pose(1), np.full((6, 6), np.nan), 12)
    with pytest.raises(UsageError, match="the information of a link is a finite 6x6 matrix"):
        move(store.engine, Move(OperationKind.REFINE, map_id, before, before, (), (bad,)))
    described = description(999)
    assert store.write_keyframe(1, record(0, described)).created is False
