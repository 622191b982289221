"""Galera of MariaDB, three nodes on loopback that all take writes: one is killed and returns, two move keyframes.

Of two moves at once one is done and the other refused; never a mixture. Each node runs its whole transaction before any
commits, so that neither waits for the rows of the other: only what both write tells the cluster that they are at odds.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import event

from semdb.database.moving import move
from semdb.database.pose_records import Move, OperationKind
from semdb.database.store import Store, open_store
from semdb.database.undoing import list_operations, undo
from semdb.errors import DatabaseError, SemdbError, UsageError
from semdb.geometry import pose_from
from tests import clusters, services
from tests.database_samples import description, fill, pose, record
from tests.integration.comparison import content
from tests.integration.test_cluster import (
    check_equal,
    ingested,
    ingesting,
    make_schema,
    reach,
    small_room,
    watched,
)
from tests.integration.test_moving import MOTION, poses_of, wanted
from tests.pose_samples import fill_estimated

SHIFT = pose_from(np.eye(3), [0.5, 0.0, 0.0])
PATIENCE_S = 20.0
LONGEST_GAP_S = 15.0


@pytest.fixture(scope="module")
def galera() -> Iterator[clusters.Galera]:
    with clusters.galera() as made:
        make_schema(made)
        yield made


@pytest.mark.long
def test_a_node_is_killed_and_returns(galera: clusters.Galera, tmp_path: Path) -> None:
    room = small_room(tmp_path)
    with open_store(galera.url(0)) as store, ingested(room, tmp_path) as undisturbed:
        with watched(galera, 1) as watch, ingesting(galera, room) as wrong:
            reach(store, 15, wrong)
            galera.nodes[1].kill()
        assert max(watch.gaps) < LONGEST_GAP_S
        assert content(store) == content(undisturbed)
    galera.rejoin(galera.nodes[1])
    check_equal(galera)
    one_node_that_is_alive_is_enough(galera)


def one_node_that_is_alive_is_enough(cluster: clusters.Cluster) -> None:
    port, alive = services.free_port(), cluster.nodes[2]
    with open_store(alive.url().replace("@", f"@127.0.0.1:{port},")) as store:
        assert isinstance(store.maps(), list)
        assert store.url == f"mysql+pymysql://semdb_test:***@127.0.0.1:{port},127.0.0.1:{alive.port}/semdb"


@dataclass
class Pair:
    """A map of two keyframes or so with another map's recording, seen from two nodes."""

    one: Store
    other: Store
    map_id: int
    source: int
    recording_id: int
    theirs: list[int]
    own: list[int]


@pytest.fixture
def pair(galera: clusters.Galera) -> Iterator[Pair]:
    with contextlib.ExitStack() as stack:
        one, other = (stack.enter_context(open_store(galera.nodes[n].url())) for n in (0, 1))
        map_id, _, theirs = fill(one)
        source, recording_id, own = fill_estimated(one)
        yield Pair(one, other, map_id, source, recording_id, theirs, own)
        for key in (map_id, source):
            one.delete_map(key)


def aligned(pair: Pair) -> Move:
    """The move of the recording into the map, found from where the map's keyframes are now."""
    found = wanted(pair.one, pair.map_id, pair.recording_id, pair.source)
    here = pair.one.poses(pair.map_id)
    return replace(found, relied_on=dict(zip(here[0], here[1], strict=True)))


def refined(pair: Pair, map_id: int, motion: np.ndarray = SHIFT) -> Move:
    ids, poses = pair.one.poses(map_id)
    before = dict(zip(ids, poses, strict=True))
    return Move(
        OperationKind.REFINE, map_id, before, {key: motion @ one for key, one in before.items()}, counted=len(ids)
    )


def both(
    first: tuple[Store, Callable[[], object]], second: tuple[Store, Callable[[], object]]
) -> list[SemdbError | None]:
    """What ended each: both have said all before the first commits, and the second commits then."""
    ready, done = threading.Barrier(2), threading.Event()
    ended: list[SemdbError | None] = [None, None]

    def run(number: int, store: Store, work: Callable[[], object]) -> None:
        waited: list[bool] = []

        def before_commit(_: object) -> None:
            if threading.current_thread() is not me or waited:
                return
            waited.append(True)
            ready.wait(PATIENCE_S)
            if number == 1:
                assert done.wait(PATIENCE_S)

        me = threading.current_thread()
        event.listen(store.engine, "commit", before_commit)
        try:
            work()
        except SemdbError as error:
            ended[number] = error
        finally:
            event.remove(store.engine, "commit", before_commit)
            if number == 0:
                done.set()

    threads = [threading.Thread(target=run, args=(n, *one)) for n, one in enumerate((first, second))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(2 * PATIENCE_S)
    assert not any(thread.is_alive() for thread in threads)
    return ended


def check_one_was_refused(galera: clusters.Galera, ended: list[SemdbError | None]) -> None:
    assert ended[0] is None
    assert isinstance(ended[1], DatabaseError | UsageError), ended
    assert any(word in str(ended[1]) for word in ("meanwhile", "moved again", "was laid on the keyframes"))
    check_equal(galera)


def at(store: Store, map_id: int, expected: dict[int, np.ndarray]) -> None:
    ids, poses = store.poses(map_id)
    assert sorted(ids) == sorted(expected)
    for key, found in zip(ids, poses, strict=True):
        np.testing.assert_allclose(found, expected[key], atol=1e-9)


def test_two_refinements_of_a_map(galera: clusters.Galera, pair: Pair) -> None:
    one, other = refined(pair, pair.map_id), refined(pair, pair.map_id, MOTION)
    ended = both((pair.one, lambda: move(pair.one.engine, one)), (pair.other, lambda: move(pair.other.engine, other)))
    check_one_was_refused(galera, ended)
    at(pair.other, pair.map_id, dict(one.after))


def test_an_alignment_first_and_a_refinement_of_its_map(galera: clusters.Galera, pair: Pair) -> None:
    """The recording was laid on keyframes that the other move takes away from under it."""
    one, other = aligned(pair), refined(pair, pair.map_id)
    ended = both((pair.one, lambda: move(pair.one.engine, one)), (pair.other, lambda: move(pair.other.engine, other)))
    check_one_was_refused(galera, ended)
    at(pair.other, pair.map_id, {**other.before, **one.after})


def test_a_refinement_first_and_an_alignment_to_its_map(galera: clusters.Galera, pair: Pair) -> None:
    one, other = aligned(pair), refined(pair, pair.map_id)
    ended = both((pair.other, lambda: move(pair.other.engine, other)), (pair.one, lambda: move(pair.one.engine, one)))
    check_one_was_refused(galera, ended)
    at(pair.one, pair.map_id, dict(other.after))
    at(pair.one, pair.source, dict(one.before))


@pytest.mark.parametrize("undo_first", [True, False])
def test_a_refinement_and_an_undo(galera: clusters.Galera, pair: Pair, undo_first: bool) -> None:
    placed = aligned(pair)
    move(pair.one.engine, placed)
    [operation] = list_operations(pair.one.engine, pair.map_id)
    again = refined(pair, pair.map_id)
    calls = [
        (pair.one, lambda: undo(pair.one.engine, operation)),
        (pair.other, lambda: move(pair.other.engine, again)),
    ]
    check_one_was_refused(galera, both(*(calls if undo_first else calls[::-1])))
    if undo_first:
        at(pair.other, pair.source, dict(placed.before))
        at(pair.other, pair.map_id, dict(placed.relied_on))
    else:
        at(pair.one, pair.map_id, dict(again.after))


def test_an_alignment_first_and_an_undo_of_what_it_relied_on(galera: clusters.Galera, pair: Pair) -> None:
    move(pair.one.engine, refined(pair, pair.map_id))
    [operation] = list_operations(pair.one.engine, pair.map_id)
    placed = aligned(pair)
    ended = both(
        (pair.one, lambda: move(pair.one.engine, placed)), (pair.other, lambda: undo(pair.other.engine, operation))
    )
    check_one_was_refused(galera, ended)
    at(pair.other, pair.map_id, {**placed.relied_on, **placed.after})


@pytest.mark.parametrize("move_first", [True, False])
def test_a_keyframe_that_is_stored_on_another_node(galera: clusters.Galera, move_first: bool) -> None:
    """It goes along, or the move is refused since the recording has one more keyframe."""
    with open_store(galera.nodes[0].url()) as one, open_store(galera.nodes[1].url()) as other:
        map_id, _, theirs = fill(one)
        source, recording_id, _ = fill_estimated(one, leave=1)
        placed = wanted(one, map_id, recording_id, source)
        made = replace(record(20, description(320)), world_from_camera=pose(120))
        calls = [
            (one, lambda: move(one.engine, placed)),
            (other, lambda: other.write_keyframe(recording_id, made)),
        ]
        ended = both(*(calls if move_first else calls[::-1]))
        if move_first:
            assert ended == [None, None]
            late = set(other.keyframe_ids(map_id)) - set(theirs) - set(placed.after)
            assert len(late) == 1
            np.testing.assert_allclose(poses_of(other, map_id, recording_id)[late.pop()], MOTION @ pose(120), atol=1e-9)
        else:
            assert ended[0] is None
            assert "stored or deleted meanwhile" in str(ended[1])
            assert len(one.keyframe_ids(source)) == len(placed.before) + 1
        check_equal(galera)
        for key in (map_id, source):
            one.delete_map(key)
