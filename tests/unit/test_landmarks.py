"""Landmarks of a rendered room with exact masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.landmarks.build import SeenKeyframe, find_landmarks
from semdb.landmarks.gravity import estimate_gravity
from semdb.landmarks.lift import Grids, LiftedKeyframe, SeenObject, lift_keyframe
from semdb.landmarks.register import corrected_poses
from semdb.landmarks.sizes import unknown_sizes
from semdb.landmarks.values import Landmarks, LandmarkState
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.types import FloatArray

KEYFRAMES = 12


class Room:
    """A rendered room: keyframes, the true label of each of their objects, poses."""

    def __init__(self, poses: FloatArray | None = None) -> None:
        options = SyntheticOptions(frames=KEYFRAMES, lap_frames=24, width=320, height=240, room_seed=7)
        sequence = SyntheticSequence(options)
        self.names = sorted(set(sequence.classes.values()))
        self.classes = sequence.classes
        self.frames = [sequence.render(k) for k in range(KEYFRAMES)]
        self.camera = sequence.camera
        self.labels = [
            [label for label in np.unique(f.labels).tolist() if label and np.count_nonzero(f.labels == label) >= 40]
            for f in self.frames
        ]
        self.poses = sequence.poses

    def keyframes(self, poses: FloatArray, seen: range = range(KEYFRAMES)) -> list[SeenKeyframe]:
        found = []
        for k in seen:
            frame = self.frames[k]
            things = [
                SeenObject(self.names.index(self.classes[label]), 0.9, frame.labels == label)
                for label in self.labels[k]
            ]
            lifted = lift_keyframe(self.camera, poses[k], frame.depth, things)
            category = np.array([thing.category for thing in things], np.int64)
            found.append(SeenKeyframe(lifted, category, np.full(len(things), 0.9), 0))
        return found


@pytest.fixture(scope="module")
def room() -> Room:
    return Room()


@pytest.fixture(scope="module")
def found(room: Room) -> Landmarks:
    return find_landmarks(room.keyframes(room.poses), len(room.names))


def test_each_landmark_is_one_thing_and_each_thing_one_landmark(room: Room, found: Landmarks) -> None:
    things = [{room.labels[m.keyframe][m.ordinal] for m in thing.members} for thing in found.landmarks]
    assert all(len(labels) == 1 for labels in things)
    often = [labels for labels, thing in zip(things, found.landmarks, strict=True) if thing.keyframes > 1]
    assert len(often) >= 10
    assert len({label for labels in often for label in labels}) == len(often)
    assert {thing.state for thing in found.landmarks if thing.keyframes > 2} == {LandmarkState.CONFIRMED}


def test_classes_and_counts_are_those_of_the_sightings(room: Room, found: Landmarks) -> None:
    for thing in found.landmarks:
        label = room.labels[thing.members[0].keyframe][thing.members[0].ordinal]
        assert room.names[thing.category] == room.classes[label]
        assert thing.evidence.sum() == pytest.approx(1)
        assert thing.keyframes == len({member.keyframe for member in thing.members})
        assert thing.first == thing.members[0].keyframe
        assert thing.last == thing.members[-1].keyframe
        assert thing.seen_through == 0
        assert np.linalg.eigvalsh(thing.covariance).min() > 0
    assert found.landmarks == tuple(sorted(found.landmarks, key=lambda thing: thing.key))


def test_up_and_floor_of_a_room(found: Landmarks) -> None:
    assert found.gravity.up == pytest.approx([0, 0, 1], abs=0.01)
    assert found.gravity.up_certainty > 0.6
    assert found.gravity.floor == pytest.approx(0, abs=0.01)
    assert found.gravity.floor_certainty > 0.5


def test_another_world_frame_gives_the_same_things_in_it(room: Room, found: Landmarks) -> None:
    world = pose_from(so3_exp([0.9, -0.4, 2.0]), [3, -7, 1])
    turned = find_landmarks(room.keyframes(world @ room.poses), len(room.names))
    assert [thing.members for thing in turned.landmarks] == [thing.members for thing in found.landmarks]
    assert turned.gravity.up == pytest.approx(world[:3, 2], abs=0.02)
    for one, other in zip(found.landmarks, turned.landmarks, strict=True):
        there = world[:3, :3] @ one.box.centre + world[:3, 3]
        assert np.linalg.norm(there - other.box.centre) < 0.05 + 0.2 * float(one.box.size.max())


def test_up_that_is_told_is_kept(room: Room) -> None:
    lifted = [frame.lifted for frame in room.keyframes(room.poses, range(3))]
    told = estimate_gravity(lifted, np.array([0.0, 0.0, 2.0]))
    assert told.given
    assert told.up.tolist() == [0, 0, 1]


def noisy(poses: FloatArray) -> FloatArray:
    rng = np.random.default_rng(3)
    return np.array([p @ pose_from(so3_exp(rng.normal(0, 0.006, 3)), rng.normal(0, 0.008, 3)) for p in poses])


def test_poses_that_do_not_fit_are_made_to(room: Room) -> None:
    spoiled = noisy(room.poses)
    lifted = [frame.lifted for frame in room.keyframes(spoiled)]
    mended = corrected_poses(lifted)

    def steps(poses: FloatArray) -> list[tuple[float, float]]:
        true = [invert_pose(a) @ b for a, b in zip(room.poses, room.poses[1:], strict=False)]
        return [pose_error(invert_pose(a) @ b, t) for a, b, t in zip(poses, poses[1:], true, strict=False)]

    before, after = np.median(steps(spoiled), axis=0), np.median(steps(mended), axis=0)
    assert after[0] < 0.4 * before[0]
    assert after[1] < 0.3 * before[1]


def test_what_later_keyframes_see_through_is_gone(room: Room) -> None:
    frames = room.keyframes(room.poses)
    pose = frames[4].lifted.world_from_camera
    # two keyframes saw something before the wall that is not there when their places are visited again
    ghost = []
    for number in (4, 5):
        own = frames[number].lifted
        depth = room.frames[number].depth.copy()
        mask = np.zeros(depth.shape, bool)
        centre = invert_pose(own.world_from_camera) @ pose @ [0.0, -0.2, 1.2, 1.0]
        u = int(room.camera.fx * centre[0] / centre[2] + room.camera.cx)
        v = int(room.camera.fy * centre[1] / centre[2] + room.camera.cy)
        mask[max(v - 15, 0) : v + 15, max(u - 15, 0) : u + 15] = True
        depth[mask] = centre[2]
        thing = lift_keyframe(room.camera, own.world_from_camera, depth, [SeenObject(0, 0.9, mask)])
        ghost.append(SeenKeyframe(thing, np.array([0]), np.array([0.9]), 0))
    later = [replace(frame, lifted=without_objects(frame.lifted)) for frame in (frames[4], frames[5], frames[6])]
    empty = [replace(f, category=np.empty(0, np.int64), score=np.empty(0)) for f in later]
    found = find_landmarks([*ghost, *empty], 1)
    [thing] = found.landmarks
    assert thing.keyframes == 2
    assert thing.seen_through >= 2
    assert thing.state is LandmarkState.GONE


def without_objects(lifted: LiftedKeyframe) -> LiftedKeyframe:
    return replace(
        lifted,
        sighting_of=np.empty(0, np.int64),
        points=(),
        areas=np.empty(0, np.int64),
        beside=np.empty((0, 0), bool),
        cut=np.empty(0, bool),
        grids=lambda: Grids((), lifted.grid_depth, np.zeros_like(lifted.grid_owner)),
    )


def test_weak_sightings_confirm_by_their_sum_and_no_thing_larger_than_its_class(room: Room, found: Landmarks) -> None:
    def again(score: float, longest: float) -> dict[tuple[int, int], LandmarkState]:
        sizes = replace(unknown_sizes(len(room.names)), longest=np.full(len(room.names), longest))
        frames = [replace(frame, score=np.full(len(frame.score), score)) for frame in room.keyframes(room.poses)]
        things = find_landmarks(frames, len(room.names), sizes=sizes).landmarks
        return {thing.key: thing.state for thing in things}

    confirmed = {thing.key: thing for thing in found.landmarks if thing.state is LandmarkState.CONFIRMED}
    weak = again(0.25, np.inf)
    for key, thing in confirmed.items():
        enough = 0.25 * thing.keyframes >= 0.5 * max(3, 0.2 * (thing.keyframes + thing.missed))
        assert (weak[key] is LandmarkState.CONFIRMED) == enough
    assert set(again(0.9, 0.01).values()) == {LandmarkState.TENTATIVE}


def test_a_map_without_objects_or_depth_has_no_landmarks(room: Room) -> None:
    assert find_landmarks([], 1).landmarks == ()
    blind = lift_keyframe(room.camera, room.poses[0], None, [SeenObject(0, 0.9, np.ones((240, 320), bool))])
    found = find_landmarks([SeenKeyframe(blind, np.array([0]), np.array([0.9]), 0)], 1)
    assert found.landmarks == ()
    assert found.without_place == 1
    assert found.gravity.up_certainty == 0
