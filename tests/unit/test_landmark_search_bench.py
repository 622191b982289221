"""What `bench.landmarks.searching` and `.together` ask, and what counts as right; keyframes that look aside."""

from __future__ import annotations

import numpy as np
import pytest

from bench.landmarks.rooms import TrueThing
from bench.landmarks.searching import Asked, Question, Tally, questions, tallies
from bench.landmarks.together import names_of
from semdb.geometry import rotation_angle_deg, so3_exp
from semdb.landmarks.boxes import Box
from semdb.landmarks.evidence import fuse, name_probabilities, perhaps
from semdb.localization.landmark_starts import TURNS, turned_cameras


def thing(name: str, place: tuple[float, float, float], size: tuple[float, float, float]) -> TrueThing:
    return TrueThing(name, Box(np.array(place), np.array(size), np.eye(3)), 5)


THINGS = {
    1: thing("dining table", (0, 0, 0.37), (1.6, 0.8, 0.74)),
    2: thing("cup", (0.3, 0.1, 0.79), (0.08, 0.08, 0.1)),
    3: thing("cup", (6, 0, 0.05), (0.08, 0.08, 0.1)),
}


def test_questions_of_a_room_with_a_cup_on_a_table_and_one_far_off() -> None:
    asked = questions(THINGS, frozenset(THINGS), [np.array([6.0, 0.5, 1.0])])
    found = {
        (q.kind, q.what, str(q.asked.get("near") or q.asked.get("on") or q.asked.get("not_near"))): q for q in asked
    }
    assert found["on", "cup", "dining table"].right == {2}
    assert found["on", "cup", "dining table"].sure
    assert found["near", "cup", "dining table"].right == {2}
    assert found["not near", "cup", "dining table"].right == {3}
    assert found["from a place", "cup", "None"].right == {3}
    assert not found["on", "dining table", "cup"].sure
    assert found["on", "dining table", "cup"].right == frozenset()
    unseen = questions(THINGS, frozenset({1, 3}), [])  # the cup on the table was not seen well: no question
    assert not any(q.sure for q in unseen if q.kind in ("on", "near"))


def test_first_hits_are_counted() -> None:
    sure = Question("on", "cup", {"on": "dining table"}, frozenset({2}), True)
    none = Question("on", "cup", {"on": "sink"}, frozenset(), False)
    asked = [Asked(sure, 2, "cup"), Asked(sure, 3, "cup"), Asked(sure, None, None), Asked(none, None, None)]
    assert tallies(asked) == {"on": Tally(asked=3, right=1, nothing=1, empty=1, none=1)}


def test_names_of_rooms_without_rendering() -> None:
    names = names_of(410, 2)
    assert {"dining table", "book", "chair"} <= set(names)
    assert sorted(names.values()) == list(range(len(names)))


def test_keyframes_look_aside_from_where_they_are() -> None:
    camera = np.eye(4)
    camera[:3, :3] = so3_exp(np.array([0.3, 1.0, -0.2]))
    camera[:3, 3] = (1.0, -2.0, 0.5)
    found = turned_cameras(camera[None], np.eye(3), 1200)
    assert len(found) == len(TURNS) == 20
    place = -camera[:3, :3].T @ camera[:3, 3]
    for one in found:
        assert np.allclose(-one[:3, :3].T @ one[:3, 3], place)
    angles = [rotation_angle_deg(one[:3, :3] @ camera[:3, :3].T) for one in found]
    assert angles[0] == pytest.approx(5)
    assert max(angles) < 20
    assert len(turned_cameras(np.repeat(camera[None], 400, axis=0), np.eye(3), 1200)) == 1200
    assert len(turned_cameras(np.repeat(camera[None], 1300, axis=0), np.eye(3), 1200)) == 0


def test_what_a_thing_may_be_is_what_it_was_called() -> None:
    evidence = fuse(np.array([3, 3, 5]), np.array([0.9, 0.9, 0.9]), name_probabilities(20))
    found = perhaps(evidence, 3, [3, 3, 5])
    assert set(found) == {5}
    assert 0.002 < found[5] < 0.02
    assert perhaps(evidence, 3, [3]) == {}
    assert perhaps(fuse(np.array([3] * 6 + [5]), np.full(7, 0.9), name_probabilities(20)), 3, [3, 5]) == {}
