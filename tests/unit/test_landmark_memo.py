"""Landmarks with what was remembered of other keyframes are those of a computation from nothing, bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from functools import lru_cache

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.landmarks.build import SeenKeyframe, find_landmarks
from semdb.landmarks.gravity import on_lattice
from semdb.landmarks.lift import SeenObject, lift_keyframe
from semdb.landmarks.memo import Arrays, name_of
from semdb.landmarks.options import SeeOptions
from semdb.landmarks.places import places_of
from semdb.landmarks.visibility import THROUGH, VISIBLE, _look_in, collect, look
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence

FRAMES = 7


class Remembered:
    """A memo in memory that counts what it has."""

    def __init__(self) -> None:
        self.arrays: dict[tuple[str, str], Arrays] = {}
        self.asked = {True: 0, False: 0}

    def get(self, kind: str, name: str) -> Arrays | None:
        found = self.arrays.get((kind, name))
        self.asked[found is not None] += 1
        return found

    def put(self, kind: str, name: str, arrays: Arrays) -> None:
        self.arrays[kind, name] = arrays

    def keep(self, kind: str, name: str) -> None:
        assert (kind, name) in self.arrays


@lru_cache(maxsize=1)
def keyframes() -> tuple[SeenKeyframe, ...]:
    """Of two places far from each other, one after the other; the second recording is of both."""
    sequence = SyntheticSequence(SyntheticOptions(frames=FRAMES, lap_frames=18, width=160, height=120, room_seed=7))
    found = []
    for index in range(FRAMES):
        frame = sequence.render(index)
        labels = [label for label in sequence.classes if np.count_nonzero(frame.labels == label) > 40]
        masks = [frame.labels == label for label in labels]
        things = [SeenObject(label % 5, 0.9, mask) for label, mask in zip(labels, masks, strict=True)]
        lifted = lift_keyframe(sequence.camera, frame.world_from_camera, frame.depth, things)
        category = np.array([thing.category for thing in things], np.int64)
        for place in (0.0, 40.0):
            pose = frame.world_from_camera.copy()
            pose[0, 3] += place
            here = replace(lifted, world_from_camera=pose, name=f"{index} {place}")
            found.append(SeenKeyframe(here, category, np.full(len(things), 0.9), index % 2))
    return tuple(sorted(found, key=lambda frame: frame.recording))


def moved(frame: SeenKeyframe, metres: float) -> SeenKeyframe:
    pose = frame.lifted.world_from_camera.copy()
    pose[1, 3] += metres
    return replace(frame, lifted=replace(frame.lifted, world_from_camera=pose))


def plain(value: object) -> object:
    """Values as they can be compared to the last bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if is_dataclass(value) and not isinstance(value, type):
        return [plain(getattr(value, field.name)) for field in fields(value)]
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return repr(value)


STEPS = st.lists(st.tuples(st.sampled_from(["add", "delete", "move"]), st.integers(0, 10**6)), min_size=1, max_size=3)


@settings(max_examples=3, deadline=None)
@given(steps=STEPS)
def test_any_sequence_of_changes_gives_what_a_computation_from_nothing_gives(
    steps: Sequence[tuple[str, int]],
) -> None:
    everything, memo = keyframes(), Remembered()
    there = set(range(0, len(everything), 2)) | {1, 3}
    now = dict(enumerate(everything))
    find_landmarks([now[k] for k in sorted(there)], 5, memo=memo)
    for step, seed in steps:
        rng = np.random.default_rng(seed)
        if step == "add":
            there.add(int(rng.integers(len(everything))))
        elif len(there) > 2:
            chosen = int(rng.choice(sorted(there)))
            if step == "delete":
                there.discard(chosen)
            else:
                now[chosen] = moved(now[chosen], float(rng.uniform(-0.02, 0.02)))
    chosen_frames = [now[k] for k in sorted(there)]
    assert plain(find_landmarks(chosen_frames, 5, memo=memo)) == plain(find_landmarks(chosen_frames, 5))


def test_what_another_place_sees_is_not_computed_again() -> None:
    frames, memo = keyframes(), Remembered()
    far = [k for k, frame in enumerate(frames) if frame.lifted.world_from_camera[0, 3] > 20]
    find_landmarks([frame for k, frame in enumerate(frames) if k not in far[:3]], 5, memo=memo)
    before = set(memo.arrays)
    memo.asked = {True: 0, False: 0}
    find_landmarks(frames, 5, memo=memo)
    new = [kind for kind, _ in set(memo.arrays) - before]
    assert (new.count("poses"), new.count("surface")) == (1, 3)
    things = sum(kind == "points" for kind, _ in memo.arrays)
    assert 0 < new.count("points") <= 0.6 * things  # the things of the other place stay
    memo.asked = {True: 0, False: 0}
    find_landmarks(frames, 5, memo=memo)
    assert memo.asked[False] == 0


def test_beyond_its_reach_a_keyframe_sees_nothing() -> None:
    lifted = [frame.lifted for frame in keyframes()]
    sightings, see = collect(lifted), SeeOptions()
    views = look(lifted, sightings, see)
    seen = set(zip(views.sighting.tolist(), views.keyframe.tolist(), strict=True))
    everything, beyond = np.arange(len(sightings)), 0
    for number, frame in enumerate(lifted):
        rows, _, counts, pair, _, both = _look_in(number, frame, sightings, everything, see)
        outside = np.array([(row, number) not in seen for row in rows.tolist()])
        beyond += np.count_nonzero(outside)
        assert not counts[outside][:, [VISIBLE, THROUGH]].any()
        assert not both[outside[pair]].any()  # nor behind a mask
    assert beyond > 0


def test_names_tell_apart_what_is_not_the_same() -> None:
    one = np.arange(6.0)
    names = [
        name_of(one, 1),
        name_of(one.reshape(2, 3), 1),
        name_of(one.astype(np.float32), 1),
        name_of(one, 1.0),
        name_of(one, "1"),
        name_of([one, 1]),
        name_of(one, [1]),
        name_of(one, None),
        name_of(one),
        name_of("ab", "c"),
        name_of("a", "bc"),
    ]
    assert len(set(names)) == len(names)
    assert name_of(one[::2]) == name_of(np.array([0.0, 2.0, 4.0]))


def test_places_are_chains_of_keyframes() -> None:
    centres = np.array([[0.0, 0, 0], [9, 0, 0], [3, 0, 0], [6, 0, 0], [20, 0, 0]])
    assert [rows.tolist() for rows in places_of(centres, 4.0)] == [[0, 1, 2, 3], [4]]
    assert [rows.tolist() for rows in places_of(centres, 2.0)] == [[0], [1], [2], [3], [4]]
    assert places_of(np.empty((0, 3)), 4.0) == []


def test_up_is_one_of_few_directions() -> None:
    up = np.array([0.0004, -0.0003, 1.0])
    np.testing.assert_array_equal(on_lattice(up), [0, 0, 1])
    tilted = on_lattice(np.array([0.1, 0.2, 0.97]) / np.linalg.norm([0.1, 0.2, 0.97]))
    assert np.linalg.norm(tilted) == 1.0 or abs(np.linalg.norm(tilted) - 1) < 1e-15
    assert np.degrees(np.arccos(tilted @ [0.1, 0.2, 0.97] / np.linalg.norm([0.1, 0.2, 0.97]))) < 0.12
