"""Synthetic recordings: geometry as numbers, determinism, options, layout on disk."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.geometry import back_project, invert_pose, project, rotation_from_quat_wxyz, transform_points
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence, render, scene, write_synthetic_recording
from semdb.recordings.synthetic.room import build_room, overlaps
from semdb.types import Camera

SMALL = SyntheticOptions(frames=6, width=160, height=120)


@pytest.fixture(scope="module")
def sequence() -> SyntheticSequence:
    return SyntheticSequence(SMALL)


def ball_room() -> scene.PackedScene:
    """A room of 4 x 4 x 4 m with a ball of 0.5 m radius in its middle and a box of 1 m on the side of +x."""
    texture = scene.Texture(np.full((4, 4, 3), 200, np.uint8))
    plain = scene.Material(texture)
    walls = scene.Prim(scene.ROOM, np.eye(4), (2.0, 2.0, 2.0), 0.0, (plain,) * 6)
    items = [
        scene.Item(None, [walls], np.eye(4)),
        scene.Item("ball", [scene.ball((0, 0, 0), (0.5, 0.5, 0.5), plain)], np.eye(4), label=7),
        scene.Item("box", [scene.box((1.4, 0, -0.5), (0.4, 1.0, 1.0), plain)], np.eye(4), label=9),
        scene.Item("can", [scene.cylinder((0, 1.2, -0.3), 0.25, 0.6, plain)], np.eye(4), label=11),
    ]
    return scene.pack(items)


def test_depth_of_known_shapes() -> None:
    camera = Camera(101, 101, 80.0, 80.0, 50.0, 50.0)
    look_along_x = np.array([[0, 0, 1.0, -1.5], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    view = render.render_view(ball_room(), camera, look_along_x)
    assert view.depth[50, 50] == pytest.approx(1.0, abs=1e-6)  # front of the ball, 1.5 - 0.5
    assert view.labels[50, 50] == 7
    assert view.depth[50, 100] == pytest.approx(2.0 / (50 / 80), abs=1e-5)  # wall at y = -2, seen at x = 50/80
    assert view.labels[50, 100] == 0
    # the ball's outline: tangent at sin = 0.5 / 1.5
    radius = 80 * np.tan(np.arcsin(0.5 / 1.5))
    assert int((view.labels[50] == 7).sum()) == pytest.approx(2 * radius, abs=1.01)
    look_along_y = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0.7], [0, -1, 0, 0], [0, 0, 0, 1]])
    view = render.render_view(ball_room(), camera, look_along_y)
    assert view.depth[50, 50] == pytest.approx(1.2 - 0.25 - 0.7, abs=1e-6)  # the can's side
    assert view.labels[50, 50] == 11
    look_along_y[:3, 3] = [1.4, -1.8, 0.0]
    view = render.render_view(ball_room(), camera, look_along_y)
    assert view.depth[50, 50] == pytest.approx(1.8 - 0.5, abs=1e-6)  # the box, 0.4 m wide and 1 m high
    assert int((view.labels[50] == 9).sum()) == pytest.approx(0.4 / 1.3 * 80, abs=1.01)
    assert int((view.labels[:, 50] == 9).sum()) == pytest.approx(1.0 / 1.3 * 80, abs=1.01)


def test_frames_agree_in_depth_label_and_colour(sequence: SyntheticSequence) -> None:
    camera = sequence.camera
    first, second = sequence.render(0), sequence.render(3)
    v, u = np.mgrid[0 : camera.height, 0 : camera.width]
    pixels = np.column_stack([u.ravel(), v.ravel()])
    points = back_project(camera, pixels, first.depth.ravel())
    relative = invert_pose(second.world_from_camera) @ first.world_from_camera
    moved = transform_points(relative, points)
    at = np.rint(project(camera, moved)).astype(int)
    inside = (at >= 0).all(axis=1) & (at < [camera.width, camera.height]).all(axis=1) & (moved[:, 2] > 0)
    assert inside.mean() > 0.5
    a, b = at[inside].T
    error = np.abs(second.depth[b, a] - moved[inside, 2]) / moved[inside, 2]
    visible = error < 0.05
    assert visible.mean() > 0.9
    assert np.median(error) < 0.003  # half a pixel of slope, no more
    same_label = first.labels.ravel()[inside] == second.labels[b, a]
    assert same_label[visible].mean() > 0.97
    grey = [cv2.cvtColor(f.rgb, cv2.COLOR_RGB2GRAY).astype(float) for f in (first, second)]
    change = np.abs(grey[0].ravel()[inside] - grey[1][b, a])
    assert np.median(change[visible]) < 6


def test_sub_pixel_depth_is_exact(sequence: SyntheticSequence) -> None:
    """Every point of frame 0, as a ray of frame 1, must meet the surface at its own depth."""
    camera = sequence.camera
    frame = sequence.render(0)
    pixels = np.array([[u, v] for u in range(8, 160, 12) for v in range(8, 120, 12)], float)
    depth = frame.depth[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    world = transform_points(frame.world_from_camera, back_project(camera, pixels, depth))
    x, y, z = sequence.room.size
    assert (np.abs(world) <= np.array([x / 2, y / 2, z]) + 1e-5).all()
    # a camera whose middle pixel looks exactly at each point, from the same place
    for pixel, point, expected in itertools.islice(zip(pixels, world, depth, strict=True), 0, None, 17):
        shifted = dataclasses.replace(
            camera, cx=camera.cx - pixel[0] + 3, cy=camera.cy - pixel[1] + 3, width=7, height=7
        )
        view = render.render_view(sequence._packed, shifted, frame.world_from_camera)
        assert view.depth[3, 3] == pytest.approx(expected, rel=1e-6)
        assert np.isfinite(point).all()


def digest(sequence: SyntheticSequence) -> str:
    total = hashlib.sha256()
    for i in range(2):
        frame = sequence.render(i)
        for array in (frame.rgb, frame.depth, frame.labels, frame.world_from_camera):
            total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()


def test_equal_options_make_equal_frames(sequence: SyntheticSequence) -> None:
    noisy = dataclasses.replace(SMALL, noise=True, blur=0.5, lighting=0.5)
    assert digest(SyntheticSequence(SMALL)) == digest(sequence)
    assert digest(SyntheticSequence(noisy)) == digest(SyntheticSequence(noisy))
    assert digest(SyntheticSequence(dataclasses.replace(SMALL, seed=1))) != digest(sequence)
    layouts = [sequence.room, build_room(0)]
    assert [i.category for i in layouts[0].items] == [i.category for i in layouts[1].items]
    for a, b in zip(layouts[0].items, layouts[1].items, strict=True):
        np.testing.assert_array_equal(a.pose, b.pose)


@pytest.mark.parametrize(
    ("change", "colour_changes", "depth_changes"),
    [({"noise": True}, True, True), ({"blur": 0.6}, True, False), ({"lighting": 0.7}, True, False)],
)
def test_an_option_changes_what_it_should_and_nothing_else(
    sequence: SyntheticSequence, change: dict[str, float], colour_changes: bool, depth_changes: bool
) -> None:
    plain = sequence.render(1)
    other = SyntheticSequence(dataclasses.replace(SMALL, **change)).render(1)
    np.testing.assert_array_equal(plain.world_from_camera, other.world_from_camera)
    np.testing.assert_array_equal(plain.labels, other.labels)
    assert (not np.array_equal(plain.rgb, other.rgb)) == colour_changes
    assert (not np.array_equal(plain.depth, other.depth)) == depth_changes


def test_depth_noise_is_that_of_a_sensor(sequence: SyntheticSequence) -> None:
    noisy = SyntheticSequence(dataclasses.replace(SMALL, noise=True))
    errors, depths = [], []
    for i in range(0, 6, 2):
        truth, measured = sequence.render(i).depth, noisy.render(i).depth
        valid = measured > 0
        assert 0.5 < valid.mean() < 0.995  # holes, but not everywhere
        errors.append((measured - truth)[valid])
        depths.append(truth[valid])
    error, depth = np.concatenate(errors), np.concatenate(depths)
    near, far = error[depth < 2.0], error[depth > 3.0]
    assert abs(np.median(near)) < 0.003
    assert 0.002 < near.std() < 0.015
    assert far.std() > 1.8 * near.std()


def test_blur_is_along_the_motion_and_dims_detail(sequence: SyntheticSequence) -> None:
    blurred = SyntheticSequence(dataclasses.replace(SMALL, blur=1.0))
    detail = [np.abs(cv2.Laplacian(s.render(2).rgb.astype(np.float32), cv2.CV_32F)).mean() for s in (sequence, blurred)]
    assert detail[1] < 0.7 * detail[0]


def test_second_visit_moves_objects_and_shares_the_walls(sequence: SyntheticSequence) -> None:
    second = SyntheticSequence(dataclasses.replace(SMALL, second_visit=True))
    assert second.room.size == sequence.room.size
    assert second.classes == sequence.classes
    before = {i.label: i.pose for i in sequence.room.items if i.label}
    after = {i.label: i.pose for i in second.room.items if i.label}
    moved = {k for k in before if not np.allclose(before[k], after[k])}
    assert moved == set(second.moved)
    assert second.taken == ()
    robbed = SyntheticSequence(dataclasses.replace(SMALL, second_visit=True, taken=0.5))
    assert len(robbed.taken) >= 3
    assert set(robbed.taken).isdisjoint(robbed.moved)
    assert not any(np.isin(robbed.render(k).labels, robbed.taken).any() for k in range(2))
    assert len(moved) >= 4
    walls = [[i.pose for i in s.room.items if not i.label] for s in (sequence, second)]
    np.testing.assert_array_equal(walls[0], walls[1])
    assert not np.allclose(second.poses[0], sequence.poses[0])
    # seen from the same place, the two visits differ where objects moved and agree on most of the room
    pose = sequence.poses[0]
    views = [render.render_view(s._packed, SMALL.camera, pose) for s in (sequence, second)]
    agree = np.abs(views[0].depth - views[1].depth) < 1e-4
    assert agree.mean() > 0.8


def test_rooms_can_be_told_apart_by_their_classes(sequence: SyntheticSequence) -> None:
    kinds = []
    for room in (sequence.room, build_room(1), build_room(2)):
        kinds.append(frozenset(room.classes().values()))
        assert {"chair", "dining table"} <= kinds[-1]
        assert len(kinds[-1]) >= 8
        table_and_chairs = 1 + sum(1 for c in room.classes().values() if c == "chair")
        others = room.solid[1 + table_and_chairs :]
        assert not any(overlaps(a, b) for a, b in itertools.combinations(others, 2))
    assert len(set(kinds)) == 3


def test_walk_turns_all_around_and_stays_clear() -> None:
    sequence = SyntheticSequence(SyntheticOptions(frames=120, width=64, height=48))
    poses = sequence.poses
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (120, 1, 1)), atol=1e-12
    )
    heading = np.unwrap(np.arctan2(poses[:, 1, 2], poses[:, 0, 2]))
    assert abs(heading[-1] - heading[0]) == pytest.approx(2 * np.pi * 119 / 120, abs=0.25)
    assert np.abs(np.diff(heading)).max() < np.radians(6)
    assert poses[:, 2, 3].min() > 1.15
    assert poses[:, 2, 3].max() < 1.65
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.15
    for i in range(0, 120, 6):
        assert sequence.render(i).depth.min() > 0.15


def test_views_have_features_and_objects() -> None:
    sequence = SyntheticSequence(SyntheticOptions(frames=120))
    sift = cv2.SIFT_create()
    keypoints, objects = [], []
    for i in range(0, 120, 24):
        frame = sequence.render(i)
        keypoints.append(len(sift.detect(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), None)))
        _, pixels = np.unique(frame.labels[frame.labels > 0], return_counts=True)
        objects.append(int((pixels > 400).sum()))
    assert np.median(keypoints) >= 600
    assert min(keypoints) >= 250
    assert np.median(objects) >= 3


def test_layout_on_disk(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "room"
    calls: list[tuple[int, int]] = []
    write_synthetic_recording(folder, SMALL, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(k, 6) for k in range(1, 7)]
    assert [p.name for p in folder.parent.iterdir()] == ["room"]  # nothing half-written is left
    sequence = SyntheticSequence(SMALL)
    lists = {
        n: [r.split() for r in (folder / f"{n}.txt").read_text().splitlines() if r[0] != "#"] for n in ("rgb", "depth")
    }
    poses = np.loadtxt(folder / "groundtruth.txt")
    assert poses.shape == (6, 8)
    np.testing.assert_allclose(np.diff(poses[:, 0]), 1 / 30, atol=2e-6)
    classes = json.loads((folder / "masks" / "classes.json").read_text())
    lens = json.loads((folder / "camera.json").read_text())
    assert lens == {
        "width": 160,
        "height": 120,
        "fx": 131.2,
        "fy": 131.2,
        "cx": 79.5,
        "cy": 59.5,
        "distortion": [],
        "depth_scale": 5000,
    }
    for i in range(6):
        frame = sequence.render(i)
        rgb = cv2.imread(str(folder / lists["rgb"][i][1]))
        np.testing.assert_array_equal(rgb[..., ::-1], frame.rgb)
        depth = cv2.imread(str(folder / lists["depth"][i][1]), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        np.testing.assert_allclose(depth / 5000.0, frame.depth, atol=1.01e-4)
        labels = cv2.imread(str(folder / "masks" / Path(lists["rgb"][i][1]).name), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(labels, frame.labels)
        assert {str(k) for k in np.unique(labels) if k} <= set(classes)
        np.testing.assert_array_equal(poses[i, 1:4], frame.world_from_camera[:3, 3])
        rotation = rotation_from_quat_wxyz(poses[i, [7, 4, 5, 6]])
        np.testing.assert_allclose(rotation, frame.world_from_camera[:3, :3], atol=1e-12)


def test_refuses_a_folder_that_is_not_empty(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    with pytest.raises(UsageError, match="not empty"):
        write_synthetic_recording(tmp_path, SMALL)
    assert [p.name for p in tmp_path.iterdir()] == ["precious.txt"]
    with pytest.raises(UsageError, match="not empty"):
        write_synthetic_recording(tmp_path / "precious.txt", SMALL)


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        raise KeyboardInterrupt

    (tmp_path / "out").mkdir()  # empty: may be used
    with pytest.raises(KeyboardInterrupt):
        write_synthetic_recording(tmp_path / "out", SMALL, progress=interrupt)
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.parametrize("change", [{"frames": 0}, {"blur": 1.5}, {"lighting": -0.1}, {"width": 4}, {"seed": -1}])
def test_options_out_of_range(change: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(change))):
        SyntheticOptions(**change)  # type: ignore[arg-type]


def test_another_height_lens_and_direction_are_of_the_same_walk(sequence: SyntheticSequence) -> None:
    low = SyntheticSequence(dataclasses.replace(SMALL, eye_height=0.9, focal=0.5))
    np.testing.assert_allclose(sequence.poses[:, 2, 3] - low.poses[:, 2, 3], 0.5)
    np.testing.assert_array_equal(sequence.poses[:, :2], low.poses[:, :2])
    assert low.camera.fx == pytest.approx(0.5 * SMALL.width)
    back = SyntheticSequence(dataclasses.replace(SMALL, backwards=True))
    turns = [np.cross(s.poses[0][:3, 2], s.poses[1][:3, 2])[2] for s in (sequence, back)]  # of where it looks
    assert turns[0] * turns[1] < 0
    np.testing.assert_allclose(back.poses[0][:3, 3], sequence.poses[0][:3, 3], atol=0.6)


def test_a_bare_room_has_nothing_small_and_hardly_a_colour(sequence: SyntheticSequence) -> None:
    plain, bare = (
        SyntheticSequence(dataclasses.replace(SMALL, **{name: True})).render(2) for name in ("plain", "bare")
    )
    kinds = {label: sequence.classes[label] for label in np.unique(bare.labels) if label}
    assert not {"book", "cup", "bottle", "vase", "wine glass"} & set(kinds.values())
    assert set(kinds) <= set(np.unique(sequence.render(2).labels))
    saturation = [np.ptp(frame.rgb.astype(int), axis=2).mean() for frame in (plain, bare)]
    assert saturation[1] < 0.75 * saturation[0]
