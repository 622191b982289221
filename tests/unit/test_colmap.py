"""What the peer COLMAP finds in rendered views of a textured box: poses, points, and poses made better."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from semdb.errors import FrameError, ModelError, RecordingError, UsageError
from semdb.evaluation.colmap import (
    HALF_PIXEL,
    PosedImages,
    SiftExtractor,
    colmap_camera,
    image_points,
    load_pycolmap,
    match_descriptors,
)
from semdb.evaluation.colmap_method import ColmapReference
from semdb.evaluation.refined_truth import align_poses, choose_pairs, disagreement, refine_poses
from semdb.evaluation.rgbd_bundle import BASELINE_M, virtual_pixels
from semdb.evaluation.rolling_shutter import rates_between
from semdb.geometry import back_project, pose_error, pose_from, project, so3_exp
from semdb.types import Camera, Float32Array, FloatArray, Frame, ImageArray, Verdict

CAMERA = Camera(320, 240, 260.0, 262.0, 159.5, 119.5)
LOW, HIGH = np.array([-1.6, -1.1, -1.0]), np.array([1.6, 1.1, 2.4])


def texture(seed: int) -> Float32Array:
    noise = np.random.default_rng(seed).integers(0, 256, (160, 160), np.uint8)
    return cv2.GaussianBlur(cv2.resize(noise, (800, 800), interpolation=cv2.INTER_CUBIC), (0, 0), 1.2).astype(
        np.float32
    )


TEXTURES = [texture(seed) for seed in range(6)]


def view(
    pose: FloatArray, camera: Camera = CAMERA, rate: FloatArray | None = None, readout_s: float = 0.0
) -> tuple[ImageArray, Float32Array]:
    """Colour and depth of a box with a texture of its own on every wall, seen from inside.

    A camera that turns at `rate` while it reads row after row has its `pose` at the middle one.
    """
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    times = (np.arange(camera.height) / camera.height - 0.5) * readout_s
    turns = np.stack([so3_exp(time * (np.zeros(3) if rate is None else rate)) for time in times])
    rays = np.einsum("rij,rcj->rci", turns, rays.reshape(camera.height, camera.width, 3)).reshape(-1, 3)
    directions, origin = rays @ pose[:3, :3].T, pose[:3, 3]
    with np.errstate(divide="ignore"):
        t = np.maximum((LOW - origin) / directions, (HIGH - origin) / directions)
    wall = np.argmin(t, axis=1)
    depth = t[np.arange(len(t)), wall]
    points = origin + directions * depth[:, None]
    shape = (camera.height, camera.width)
    grey = np.zeros(shape, np.float32)
    for axis in range(3):
        for side in (0, 1):
            on = ((wall == axis) & ((directions[:, axis] > 0) == bool(side))).reshape(shape)
            place = (np.delete(points, axis, axis=1) * 200 + 400).astype(np.float32).reshape(*shape, 2)
            drawn = cv2.remap(TEXTURES[2 * axis + side], place[..., 0], place[..., 1], cv2.INTER_LINEAR)
            grey[on] = drawn[on]
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8), depth.reshape(shape).astype(np.float32)


def frame(pose: FloatArray, index: int) -> Frame:
    image, depth = view(pose)
    return Frame(index, f"{index}.png", None, image, depth, CAMERA, pose)


def walk(count: int) -> FloatArray:
    return np.stack(
        [
            pose_from(so3_exp([0.02 * i, 0.06 * i - 0.15, 0.0]), [0.12 * i - 0.3, 0.05 * (i % 2), 0.03 * i])
            for i in range(count)
        ]
    )


@pytest.fixture(scope="module")
def reference() -> ColmapReference:
    return ColmapReference([("box", frame(pose, 10 * i)) for i, pose in enumerate(walk(6))], map_name="box")


def test_colmap_finds_a_rendered_view(reference: ColmapReference) -> None:
    truth = pose_from(so3_exp([0.05, 0.04, 0.03]), [0.05, 0.02, 0.1])
    query = frame(truth, 99)
    answer = reference.localize(query)
    assert answer.verdict is Verdict.LOCALIZED
    assert answer.world_from_camera is not None
    metres, degrees = pose_error(answer.world_from_camera, truth)
    assert metres < 0.004
    assert degrees < 0.1
    assert answer.inliers > 100
    assert answer.keyframes_matched == len(reference) == 6
    assert sum(candidate.inliers for candidate in answer.candidates) == answer.inliers
    assert answer.query_xy is not None
    assert answer.keyframe_xy is not None
    again = reference.localize(query)
    assert np.array_equal(again.world_from_camera, answer.world_from_camera)
    best = next(c for c in answer.candidates if c.keyframe_id == answer.best_keyframe_id)
    assert (best.recording, best.frame_index) == reference.names[best.keyframe_id]
    keyframe = reference.poses[best.keyframe_id]
    _, depth = view(keyframe)
    rows = np.rint(answer.keyframe_xy).astype(int)
    world = (
        back_project(CAMERA, answer.keyframe_xy, depth[rows[:, 1], rows[:, 0]]) @ keyframe[:3, :3].T + keyframe[:3, 3]
    )
    seen = project(CAMERA, (world - truth[:3, 3]) @ truth[:3, :3])
    assert np.median(np.linalg.norm(seen - answer.query_xy, axis=1)) < 0.6  # both are pixels as semdb counts them


def test_colmap_fails_where_nothing_matches(reference: ColmapReference) -> None:
    grey = Frame(5, "grey.png", None, np.full((240, 320, 3), 128, np.uint8), None, CAMERA, np.eye(4))
    answer = reference.localize(grey)
    assert (answer.verdict, answer.world_from_camera, answer.inliers) == (Verdict.FAILED, None, 0)
    assert answer.candidates == ()


def test_colmap_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="at least one keyframe"):
        ColmapReference([])
    lost = Frame(5, "lost.png", None, np.zeros((240, 320, 3), np.uint8), None, CAMERA, None)
    with pytest.raises(FrameError, match=r"lost\.png.*needs a pose"):
        ColmapReference([("box", lost)])
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(ModelError, match="pip install 'pycolmap"):
        load_pycolmap()


def test_points_are_triangulated_with_the_pixels_of_colmap() -> None:
    poses = walk(4)
    images = [view(pose) for pose in poses]
    extractor = SiftExtractor()
    posed = PosedImages([CAMERA] * 4, [extractor.extract(image) for image, _ in images])
    posed.match([(a, b) for a in range(4) for b in range(a + 1, 4)])
    model = posed.triangulate(poses)
    rows, points = image_points(model, 1)
    local = (points - poses[0][:3, 3]) @ poses[0][:3, :3]
    seen = project(CAMERA, local) - (posed.images[0].xy[rows] - HALF_PIXEL)
    assert len(rows) > 150
    assert np.abs(np.median(seen, axis=0)).max() < 0.05  # half a pixel would show
    on_wall = np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1)
    assert np.median(on_wall) < 0.004


def test_cameras_carry_distortion_over() -> None:
    lens = Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
    points = np.array([[0.3, -0.2, 1.5], [-0.4, 0.3, 1.2], [0.0, 0.0, 1.0]])
    theirs = np.array([colmap_camera(lens).img_from_cam(point) for point in points]).reshape(-1, 2)
    assert theirs - HALF_PIXEL == pytest.approx(project(lens, points), abs=1e-9)
    assert colmap_camera(CAMERA).model.name == "PINHOLE"


def test_matches_are_mutual_and_clear() -> None:
    rng = np.random.default_rng(1)
    base = rng.normal(size=(40, 128)).astype(np.float32)
    base /= np.linalg.norm(base, axis=1, keepdims=True)
    order = rng.permutation(40)
    assert match_descriptors(base, base[order]).tolist() == [[i, int(j)] for i, j in enumerate(np.argsort(order))]
    twice = np.vstack([base, base[:5]]) + rng.normal(0, 0.02, (45, 128)).astype(np.float32)
    twice /= np.linalg.norm(twice, axis=1, keepdims=True)
    assert match_descriptors(base, twice)[:, 0].tolist() == list(range(5, 40))  # what is there twice is not clear
    assert match_descriptors(base[:1], base).shape == (0, 2)


def test_virtual_camera_sees_depth_as_disparity() -> None:
    pixels = virtual_pixels(CAMERA, np.array([[0.0, 0.0, 2.0], [0.5, -0.2, 4.0]]))
    assert pixels[0] == pytest.approx([160.0 - 260 * BASELINE_M / 2, 120.0])
    assert pixels[1] == pytest.approx([160.0 + 260 * (0.5 - BASELINE_M) / 4, 120.0 - 262 * 0.2 / 4])


def test_alignment_undoes_a_similarity() -> None:
    poses = walk(8)
    turn = so3_exp([0.3, -0.2, 0.5])
    moved = np.stack([pose_from(turn @ pose[:3, :3], 0.7 * turn @ pose[:3, 3] + [1, 2, 3]) for pose in poses])
    back, scale = align_poses(moved, poses)
    assert scale == pytest.approx(1 / 0.7)
    assert np.abs(back - poses).max() < 1e-9
    still = np.stack([pose_from(so3_exp([0.0, 0.1 * i, 0.0]), [0, 0, 0]) for i in range(4)])
    assert align_poses(still, still)[1] == 1.0  # a camera that only turns has no scale


def test_pairs_are_near_and_spread() -> None:
    pairs = choose_pairs(walk(30))
    assert all(a < b for a, b in pairs)
    assert {(i, i + 1) for i in range(29)} <= set(pairs)
    assert len(pairs) < 30 * 12
    far = np.stack([np.eye(4), pose_from(np.eye(3), [50.0, 0, 0])])
    assert choose_pairs(far) == []


def test_refined_poses_are_nearer_to_the_truth_than_disturbed_ones() -> None:
    truth = walk(8)
    rng = np.random.default_rng(4)
    disturbed = np.stack(
        [
            pose_from(pose[:3, :3] @ so3_exp(rng.normal(0, 0.008, 3)), pose[:3, 3] + rng.normal(0, 0.012, 3))
            for pose in truth
        ]
    )
    images = [view(pose) for pose in truth]
    found = refine_poses([CAMERA] * 8, lambda i: images[i], disturbed, np.zeros((8, 3)), name="box")
    assert found.refined.all()
    assert found.scale == pytest.approx(1.0, abs=0.03)
    assert found.refined_px < 0.5 * found.given_px
    aligned, _ = align_poses(found.world_from_camera, truth)
    before = np.median(
        [pose_error(*pair) for pair in zip(align_poses(disturbed, truth)[0], truth, strict=True)], axis=0
    )
    after = np.median([pose_error(*pair) for pair in zip(aligned, truth, strict=True)], axis=0)
    assert after[0] < 0.2 * before[0]
    assert after[1] < 0.2 * before[1]
    figures = disagreement(disturbed, found)
    assert (figures.frames, figures.refined) == (8, 8)
    assert 0.008 < figures.median_translation_m < 0.035  # noise of 12 mm on every axis
    assert figures.median_step_translation_m is not None
    assert figures.median_step_translation_m > figures.median_translation_m  # independent from frame to frame


def test_images_read_row_by_row_tell_how_long_that_takes() -> None:
    truth = walk(4)
    rates = np.random.default_rng(6).normal(0, 0.6, (4, 3))  # 60 degrees a second
    images = [view(pose, rate=rate, readout_s=0.03) for pose, rate in zip(truth, rates, strict=True)]
    errors = []
    for known in (np.zeros((4, 3)), rates):
        found = refine_poses([CAMERA] * 4, lambda i: images[i], truth, known, name="box")
        errors.append(np.median([pose_error(*pair) for pair in zip(found.world_from_camera, truth, strict=True)], 0))
    assert found.readout_s == pytest.approx(0.03, abs=0.003)
    assert disagreement(truth, found).readout_s == found.readout_s
    assert (errors[1] < 0.25 * errors[0]).all()
    assert errors[1][0] < 0.004
    assert errors[1][1] < 0.1


def test_rates_come_from_the_poses_around() -> None:
    poses = np.stack([pose_from(so3_exp([0.0, 0.02 * i, 0.0]), [0, 0, 0]) for i in range(4)])
    assert rates_between(poses, np.array([0.0, 0.1, 0.2, 0.3])) == pytest.approx(np.tile([0, 0.2, 0], (4, 1)))
    apart = rates_between(poses, np.array([0.0, 0.1, 0.2, 5.0]))
    assert apart[1] == pytest.approx([0, 0.2, 0])
    assert not apart[2:].any()  # too long between them to tell
    assert not rates_between(poses[:1], np.array([0.0])).any()


def test_images_without_anything_in_common_cannot_be_refined() -> None:
    grey = np.full((240, 320, 3), 128, np.uint8)
    with pytest.raises(RecordingError, match=r"box: its poses cannot be refined.*--truth given"):
        refine_poses([CAMERA] * 3, lambda _: (grey, None), walk(3), np.zeros((3, 3)), name="box")
