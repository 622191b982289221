"""What visits say of things, and what changed between two of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from bench.landmarks.changes import measure, render_two, turned
from bench.landmarks.rooms import EXACT, SPOILED_NOISY
from semdb.landmarks.appearance import LENGTH, colours_of, mean_colours
from semdb.landmarks.changes import Change, SeenIn, VisitedThing, alike, find_changes
from semdb.landmarks.lift import SeenObject, lift_keyframe
from semdb.landmarks.visits import SEEN, THROUGH, Presence, witness
from semdb.types import Camera, Float32Array

CUP: Mapping[str, float] = {"cup": 0.97, "bowl": 0.03}
RED, BLUE = (np.eye(LENGTH, dtype=np.float32)[k] for k in (0, 16))
CAMERA = Camera(64, 48, 60.0, 60.0, 32.0, 24.0)


def seen(presence: Presence, at: tuple[float, float, float] | None = None, **counts: int) -> SeenIn:
    given = {"keyframes": 0, "points": 0, "seen": 0, "seen_through": 0, "occluded": 0, "missed": 0, **counts}
    size = None if at is None else np.array([0.08, 0.08, 0.1])
    return SeenIn(presence, **given, centre=None if at is None else np.array(at), size=size)


def shown(x: float, **counts: int) -> SeenIn:
    return seen(Presence.PRESENT, (x, 0.0, 0.8), keyframes=4, **counts)


EMPTY = seen(Presence.ABSENT, points=100, seen_through=90)
HIDDEN = seen(Presence.UNOBSERVED, points=100, occluded=100)


def cup(key: int, before: SeenIn | None, after: SeenIn | None, colours: Float32Array | None = None) -> VisitedThing:
    return VisitedThing(key, CUP, colours, before, after)


def told(*things: VisitedThing) -> list[tuple[str, int | None, int | None]]:
    return [
        (str(c.kind), None if c.before is None else c.before.key, None if c.after is None else c.after.key)
        for c in find_changes(things)
    ]


def test_only_what_was_seen_through_is_gone() -> None:
    assert told(cup(1, shown(0), EMPTY)) == [("disappeared", 1, None)]
    assert told(cup(1, EMPTY, shown(0))) == [("appeared", None, 1)]
    assert (
        told(cup(1, shown(0), HIDDEN), cup(2, HIDDEN, shown(3)), cup(3, shown(0), None), cup(4, shown(0), shown(0)))
        == []
    )
    once = replace(shown(0), keyframes=1)
    assert told(cup(1, once, EMPTY)) == []


def test_a_place_that_is_hidden_in_one_visit_may_be_where_a_thing_came_from() -> None:
    assert told(cup(1, shown(0), EMPTY), cup(2, HIDDEN, shown(0.2))) == [("moved", 1, 2)]
    # something is seen there, and far away it is another cup
    there = seen(Presence.UNOBSERVED, points=100, seen=60, occluded=40)
    assert told(cup(1, shown(0), EMPTY), cup(2, there, shown(0.2))) == [("disappeared", 1, None)]
    assert told(cup(1, shown(0), EMPTY), cup(2, HIDDEN, shown(9))) == [("disappeared", 1, None)]
    # half of it is seen through, half is seen
    half = seen(Presence.UNOBSERVED, points=100, seen=36, seen_through=40)
    assert told(cup(1, shown(0), half), cup(2, EMPTY, shown(1))) == [("appeared", None, 2)]
    assert told(cup(1, shown(0), half, RED), cup(2, EMPTY, shown(1), RED)) == [("moved", 1, 2)]


def test_what_is_gone_here_and_new_there_was_moved_and_each_once() -> None:
    assert told(cup(1, shown(0), EMPTY), cup(2, EMPTY, shown(1))) == [("moved", 1, 2)]
    # two of one kind: each to the nearer place; one too many is gone
    things = [cup(1, shown(0), EMPTY), cup(2, shown(3), EMPTY), cup(3, EMPTY, shown(0.5)), cup(4, EMPTY, shown(2.5))]
    assert told(*things) == [("moved", 1, 3), ("moved", 2, 4)]
    assert told(*things[:3]) == [("disappeared", 2, None), ("moved", 1, 3)]
    # colours decide where they are known
    red, blue = cup(1, shown(0), EMPTY, RED), cup(2, shown(0.3), EMPTY, BLUE)
    assert told(red, blue, cup(3, EMPTY, shown(1), RED), cup(4, EMPTY, shown(0.9), BLUE)) == [
        ("moved", 1, 3),
        ("moved", 2, 4),
    ]
    (change,) = find_changes([cup(1, shown(0), EMPTY), cup(2, EMPTY, shown(1))])
    assert change.distance == pytest.approx(1)
    assert change.score == pytest.approx(alike(cup(1, shown(0), EMPTY), cup(2, EMPTY, shown(1))), abs=1e-6)


def test_what_is_of_another_kind_is_not_what_moved() -> None:
    chair = VisitedThing(2, {"chair": 1.0}, BLUE, EMPTY, replace(shown(1), size=np.array([0.5, 0.5, 0.9])))
    assert told(cup(1, shown(0), EMPTY, RED), chair) == [("appeared", None, 2), ("disappeared", 1, None)]


def test_flat_things_that_nobody_sees_through_move_but_are_never_gone() -> None:
    missed = seen(Presence.UNOBSERVED, points=100, seen=100, missed=3)
    assert told(cup(1, shown(0), missed)) == []
    assert told(cup(1, shown(0), missed), cup(2, missed, shown(0.5))) == [("moved", 1, 2)]
    # of what is mostly hidden enough is seen through for that, too
    glimpsed = seen(Presence.UNOBSERVED, points=100, seen=5, seen_through=25, occluded=60)
    assert told(cup(1, shown(0), glimpsed)) == []
    assert told(cup(1, shown(0), glimpsed), cup(2, EMPTY, shown(0.5))) == [("moved", 1, 2)]
    once = replace(missed, missed=1)
    assert told(cup(1, shown(0), once), cup(2, once, shown(0.5))) == []


def test_a_thing_in_both_visits_moved_where_each_sees_through_the_place_in_the_other() -> None:
    apart = shown(0, points=100, seen=60, seen_through=40), shown(0.1, points=100, seen=50, seen_through=40)
    assert told(cup(1, *apart)) == [("moved", 1, 1)]
    # seen from another side only: its middle is elsewhere, and nothing is seen through
    assert told(cup(1, shown(0, points=100, seen=90), shown(0.1, points=100, seen=90, occluded=10))) == []
    assert told(cup(1, shown(0, points=100, seen_through=40), shown(0.02, points=100, seen_through=40))) == []


def test_a_keyframe_sees_points_or_sees_through_them_or_does_not() -> None:
    depth = np.full((48, 64), 2.0, np.float32)
    depth[:, 32:] = 0.0  # nothing was measured there
    points = np.array([[-0.5, 0, 2.0], [-0.5, 0, 1.5], [-0.5, 0, 2.5], [0.5, 0, 2.0], [-9, 0, 2.0], [-0.5, 0, 1.97]])
    votes = np.zeros((6, 3), np.int32)
    lens = np.array([60.0, 60.0, 32.0, 24.0, 64, 48])
    limits = np.array([0.02, 0.0, 0.05, 0.0, 0.0])
    witness(points, np.eye(4), lens, np.zeros(5), depth, 1.0, limits, votes)
    assert votes.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    assert (SEEN, THROUGH) == (0, 1)


def test_colours_tell_things_apart_and_not_their_size() -> None:
    rgb = np.zeros((48, 64, 3), np.uint8)
    rgb[:, :20], rgb[:, 20:40], rgb[:, 40:] = (200, 20, 20), (20, 20, 200), (120, 120, 120)
    masks = np.zeros((3, 48, 64), np.bool_)
    masks[0, 10:20, 2:12], masks[1, 20:40, 2:18], masks[2, 10:30, 22:36] = True, True, True
    lifted = lift_keyframe(CAMERA, np.eye(4), None, [SeenObject(0, 0.9, mask) for mask in masks])
    red, large_red, blue = colours_of(rgb, lifted)
    assert red @ large_red == pytest.approx(1)
    assert red @ blue == 0
    mean = mean_colours(np.stack([red, blue]))
    assert np.linalg.norm(mean) == pytest.approx(1)
    assert mean @ red == pytest.approx(np.sqrt(0.5))
    assert not mean_colours(np.zeros((2, LENGTH), np.float32)).any()


@pytest.mark.long
def test_a_second_visit_of_a_rendered_room() -> None:
    """Nothing that is told is wrong, and most is told; the same the other way round, with a detector's mistakes."""
    two = render_two(7, 24, 480)
    found = measure(two, EXACT)
    assert (found.wrong, found.unlooked) == (0, 0)
    assert (found.wanted, found.found) == (7, 6)  # a suitcase is hidden where it was taken from
    assert dict(found.kinds)[str(Change.MOVED)] >= 3
    back = measure(turned(two), SPOILED_NOISY)
    assert back.unlooked == 0
    assert back.wrong <= 1
