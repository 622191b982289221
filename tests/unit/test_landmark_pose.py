"""Poses by landmarks alone, on arrays: a made-up room, another one, a symmetric one, and what an image shows."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.database.landmark_reading import StoredLandmark
from semdb.geometry import invert_pose, pose_error, so3_exp
from semdb.localization.landmark_kernels import LEAST_INSIDE, PRIOR, predict, refine
from semdb.localization.landmark_pose import LandmarkPoseOptions, MapLandmarks, SeenThings, find_pose, things_of
from semdb.localization.landmark_step import landmark_pose, things_in
from semdb.localization.map_landmarks import EDGE, LOOSER, MEDIAN, MOST_EDGE, SHRUNK, SightingBoxes, map_landmarks
from semdb.types import Camera, Description, Detection, Float32Array, FloatArray, ObjectGeometry
from tests.unit.localization_scene import Scene

CAMERA = Camera(640, 480, 520.0, 520.0, 319.5, 239.5)
UP = np.array([0.0, 0.0, 1.0])
OPTIONS = LandmarkPoseOptions()
NAMES = ("chair", "cup", "tv", "sink", "book", "couch", "vase", "laptop")


def looking(place: tuple[float, float], azimuth: float, tilt: float = 0.25) -> FloatArray:
    """world_from_camera at a height of 1.4 m."""
    forward = np.array([np.cos(azimuth) * np.cos(tilt), np.sin(azimuth) * np.cos(tilt), -np.sin(tilt)])
    right = np.cross(forward, UP) / np.linalg.norm(np.cross(forward, UP))
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = (*place, 1.4)
    return pose


KEYFRAMES = np.stack([looking((0.0, 0.0), angle) for angle in np.radians(np.arange(0, 360, 30))])


def thing(number: int, name: str, place: FloatArray, size: tuple[float, float, float]) -> StoredLandmark:
    position = (float(place[0]), float(place[1]), float(place[2]))
    rest = (8, 6, 1, 0, "confirmed", None, None, None, None)
    return StoredLandmark(number, name, 1.0, {name: 1.0}, position, np.eye(3) * 1e-4, size, 0.2 * number, *rest)


def room(seed: int, each: int = 3) -> MapLandmarks:
    rng = np.random.default_rng(seed)
    made = []
    for number in range(each * len(NAMES)):
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(1.8, 3.5)
        place = np.array([away * np.cos(angle), away * np.sin(angle), rng.uniform(0.2, 1.4)])
        a, b, c = rng.uniform(0.15, 0.6, 3)
        made.append(thing(number, NAMES[number % len(NAMES)], place, (float(a), float(b), float(c))))
    found = map_landmarks(made, KEYFRAMES, UP, CAMERA, {})
    assert found is not None
    return found


def seen_from(landmarks: MapLandmarks, world_from_camera: FloatArray, seed: int, *, depth: bool) -> SeenThings:
    """What a detector sees: one in five missed, boxes off by a twentieth of their sides."""
    rng = np.random.default_rng(seed)
    camera, box = invert_pose(world_from_camera), np.empty(4)
    width, height = np.array([CAMERA.width, CAMERA.height]) / 520
    frame = np.array([-width / 2, -height / 2, width / 2, height / 2])
    category, boxes, points = [], [], []
    for m in range(len(landmarks)):
        if predict(landmarks.corners[m], landmarks.centres[m], camera, frame, box) < 0.5 or rng.random() < 0.2:
            continue
        side = np.tile(box[2:] - box[:2], 2)
        boxes.append(box + 0.05 * side * rng.standard_normal(4))
        category.append(int(np.argmax(landmarks.names[m])))
        own = camera[:3, :3] @ landmarks.centres[m] + camera[:3, 3]
        points.append(own * (1 - 0.15 * landmarks.reach[m] / own[2]) if depth else np.full(3, np.nan))
    scores = np.full(len(boxes), 0.7)
    return SeenThings(np.array(boxes), np.array(category, np.int64), scores, np.array(points), frame)


@pytest.mark.parametrize("depth", [True, False])
def test_images_between_keyframes(depth: bool) -> None:
    landmarks = room(1, each=4)
    errors, variances, asked = [], [], 0
    for number, degrees in enumerate(range(7, 360, 23)):
        true = looking((0.25, -0.2), np.radians(degrees), 0.3)
        things = seen_from(landmarks, true, number, depth=depth)
        if len(things) < 4:
            continue
        found = find_pose(things, landmarks, OPTIONS)
        asked += 1
        assert found is not None
        if not found.doubt(OPTIONS):
            errors.append(pose_error(found.world_from_camera, true))
            off = found.world_from_camera[:3, 3] - true[:3, 3]
            variances.append(off @ np.linalg.solve(found.covariance[:3, :3], off))
    assert asked >= 10
    assert len(errors) >= 0.8 * asked
    assert max(metres for metres, _ in errors) < 0.4
    assert max(degrees for _, degrees in errors) < 8
    assert 0.02 < np.median(variances) < 8


def test_another_room_gets_no_pose() -> None:
    landmarks, other = room(1), room(2)
    given = 0
    for number, degrees in enumerate(range(0, 360, 15)):
        things = seen_from(other, looking((0.0, 0.0), np.radians(degrees)), number, depth=True)
        found = find_pose(things, landmarks, OPTIONS)
        given += found is not None and not found.doubt(OPTIONS)
    assert given == 0


def test_a_symmetric_room_is_refused() -> None:
    """Every thing stands there again, turned by half a turn about the middle."""
    half = [thing(k, NAMES[k], np.array([2.0, 0.7 * k - 2.0, 0.3 + 0.1 * k]), (0.4, 0.4, 0.4)) for k in range(7)]
    again = [thing(k, one.category, np.array(one.position) * [-1, -1, 1], one.size) for k, one in enumerate(half)]
    landmarks = map_landmarks([*half, *again], KEYFRAMES, UP, CAMERA, {})
    alone = map_landmarks(half, KEYFRAMES, UP, CAMERA, {})
    assert landmarks is not None
    assert alone is not None
    things = seen_from(landmarks, looking((0.0, 0.0), 0.0), 3, depth=True)
    found, sure = find_pose(things, landmarks, OPTIONS), find_pose(things, alone, OPTIONS)
    assert found is not None
    assert sure is not None
    assert found.doubt(OPTIONS) == "landmarks agree as well elsewhere"
    assert sure.doubt(OPTIONS) == ""


@pytest.mark.parametrize("off", [0.015, 0.03, 0.2])
def test_keyframes_tell_how_far_boxes_are_off(off: float) -> None:
    """Boxes of things that fill 0.96 of their landmarks' boxes, their edges off by so much of their sides."""
    rng, known = np.random.default_rng(5), [thing(k, NAMES[k % 8], place_of(k), (0.3, 0.3, 0.3)) for k in range(24)]
    whole = map_landmarks(known, KEYFRAMES, UP, CAMERA, {})
    assert whole is not None
    assert whole.edge == EDGE
    box, frame, rows = np.empty(4), seen_from(whole, KEYFRAMES[0], 0, depth=False).frame, []
    for keyframe, pose in enumerate(whole.cameras):
        for m, centre in enumerate(whole.centres):
            corners = centre + 0.96 / SHRUNK * (whole.corners[m] - centre)
            if predict(corners, centre, pose, frame, box) == 1:
                sides = np.tile(box[2:] - box[:2], 2) + 0.1
                pixels = (box + off * sides * rng.choice([-1, 1], 4)) * 520 + [319.5, 239.5, 319.5, 239.5]
                rows.append((m, keyframe, pixels + np.array([0.5, 0.5, -0.5, -0.5])))
    landmark, keyframes = np.array([row[:2] for row in rows]).T
    seen = SightingBoxes(landmark, keyframes, np.array([row[2] for row in rows]))
    found = map_landmarks(known, KEYFRAMES, UP, CAMERA, {}, seen)
    assert found is not None
    if off < 0.1:
        assert np.allclose(
            found.corners, whole.centres[:, None] + 0.96 / SHRUNK * (whole.corners - whole.centres[:, None])
        )
    assert found.edge == pytest.approx(min(LOOSER * off / MEDIAN, MOST_EDGE), rel=0.05)
    few = SightingBoxes(landmark[:9], keyframes[:9], seen.boxes[:9])
    sparse = map_landmarks(known, KEYFRAMES, UP, CAMERA, {}, few)
    assert sparse is not None
    assert sparse.edge == EDGE


def place_of(number: int) -> FloatArray:
    angle = np.pi / 12 * number
    return np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 0.9])


def test_the_same_answer_twice_and_nothing_to_go_by() -> None:
    landmarks = room(1)
    things = seen_from(landmarks, KEYFRAMES[2], 5, depth=False)
    one, two = find_pose(things, landmarks, OPTIONS), find_pose(things, landmarks, OPTIONS)
    assert one is not None
    assert two is not None
    assert one.world_from_camera.tobytes() == two.world_from_camera.tobytes()
    nothing = things_of(CAMERA, ["zebra"], np.zeros((1, 4)), np.ones(1), np.zeros((1, 3)), landmarks, OPTIONS)
    assert len(nothing) == 0
    assert find_pose(nothing, landmarks, OPTIONS) is None
    assert map_landmarks([], KEYFRAMES, UP, CAMERA, {}) is None


def test_refining_moves_to_where_boxes_agree() -> None:
    landmarks = room(4)
    true = looking((0.1, 0.1), 0.5)
    camera = invert_pose(true)
    width, height = 640 / 520, 480 / 520
    frame = np.array([-width / 2, -height / 2, width / 2, height / 2])
    boxes, assigned, box = [], np.full(len(landmarks), -1, np.int64), np.empty(4)
    for m in range(len(landmarks)):
        if predict(landmarks.corners[m], landmarks.centres[m], camera, frame, box) > LEAST_INSIDE:
            assigned[m] = len(boxes)
            boxes.append(box.copy())
    start = camera.copy()
    start[:3, :3] = so3_exp(np.array([0.05, -0.08, 0.04])) @ start[:3, :3]
    start[:3, 3] += (0.1, -0.05, 0.1)
    information = np.zeros((6, 6))
    loose = np.full(4, 100.0)
    points = np.full((len(boxes), 3), np.nan)
    given = (landmarks.corners, landmarks.centres, landmarks.reach, np.array(boxes), points, frame, landmarks.edge)
    away = refine(*given, camera.copy(), landmarks.level, loose, assigned, start, information)
    metres, degrees = pose_error(invert_pose(start), true)
    assert metres < 0.01
    assert degrees < 0.3
    assert away < 1e-3 * PRIOR
    assert np.linalg.eigvalsh(information)[0] > 0


def test_weak_detections_count_once() -> None:
    """A sighting that is a detection is not another thing; things that move are none."""
    landmarks = room(1)
    box: Float32Array = np.array([100, 100, 200, 220], np.float32)
    chair = Detection("chair", 0.8, box, np.ones((480, 640), np.bool_))
    weak = Detection("cup", 0.3, box + 5, np.zeros((0, 0), np.bool_), weak=True)
    nowhere = ObjectGeometry(10, np.full(3, np.nan), np.full(3, np.nan))
    described = Description(
        *(CAMERA, (chair,), (nowhere,), Scene(count=5).keypoints(np.eye(4)), np.ones(4, np.float32) / 2, ()),
        sightings=(chair.sighting(480), weak.sighting(480)),
    )
    things = things_in(described, landmarks, OPTIONS)
    assert things.scores.tolist() == [0.8, 0.3]
    assert landmark_pose(described, None, OPTIONS) is None
    assert landmark_pose(described, landmarks, OPTIONS) is None
