"""A query's edges laid on those of keyframes: exact in a corner of a room, honest along a single line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import pose_error, so3_exp
from semdb.localization.confidence import sigmas
from semdb.localization.edge_alignment import EdgeOptions, EdgeRound, fit_edges, measure_edges, search_edges
from semdb.localization.edge_step import covariance_of
from semdb.localization.edges import PlacedEdges, SpaceEdges, image_edges, space_edges
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

CAMERA = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)
PLANES = (  # normals and offsets of a corner of a room: floor, two walls, ceiling
    (np.array([0.0, -1.0, 0.0]), 0.7),
    (np.array([0.0, 0.0, -1.0]), 2.5),
    (np.array([-0.8, 0.0, -0.6]), 1.9),
    (np.array([0.0, 1.0, 0.0]), 0.8),
)
SHADES = (90, 130, 200, 240)
OPTIONS = EdgeOptions()


def pose(shift: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> FloatArray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = so3_exp(np.radians(turn_deg)), shift
    return made


def look(world_from_camera: FloatArray, planes=PLANES, shades=SHADES) -> tuple[Float32Array, ImageArray]:
    """Depth and grey values of planes of one colour each."""
    fine = 3  # samples per pixel and direction: edges lie where they are to a fraction of a pixel
    v, u = (np.mgrid[: 240 * fine, : 320 * fine] + 0.5) / fine - 0.5
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    world = rays @ world_from_camera[:3, :3].T
    depth, grey = np.full(u.shape, np.inf), np.zeros(u.shape)
    for (normal, offset), shade in zip(planes, shades, strict=False):
        at = (-offset - world_from_camera[:3, 3] @ normal) / (world @ normal)
        nearer = (at > 0) & (at < depth)
        depth, grey = np.where(nearer, at, depth), np.where(nearer, float(shade), grey)
    small = grey.reshape(240, fine, 320, fine).mean(axis=(1, 3))
    middle = depth[fine // 2 :: fine, fine // 2 :: fine]
    return np.where(np.isfinite(middle), middle, np.nan).astype(np.float32), small.astype(np.uint8)


def placed(world_from_camera: FloatArray, planes=PLANES, shades=SHADES) -> PlacedEdges:
    edges = space_edges(CAMERA, *look(world_from_camera, planes, shades))
    assert edges is not None
    return PlacedEdges.at(1, edges, world_from_camera)


def test_edges_in_space_are_where_planes_meet() -> None:
    edges = placed(pose((0.1, 0.0, 0.0), (3.0, 8.0, 0.0))).edges
    off = np.sort(np.abs(np.stack([edges.points @ normal + offset for normal, offset in PLANES])), axis=0)
    assert len(edges.points) > 100
    assert np.quantile(off[1], 0.9) < 0.01  # on two planes at once
    upright = np.abs(edges.tangents[:, 1]) > 0.9
    lying = np.abs(edges.tangents[:, 1]) < 0.1
    assert upright.any()
    assert (upright | lying).mean() > 0.9


def test_a_corner_gives_the_pose_to_millimetres() -> None:
    keyframes = [placed(pose((0.2 * k, 0.0, 0.0), (0.0, 4.0 * k, 0.0))) for k in range(3)]
    true = pose((0.25, -0.1, 0.1), (4.0, 10.0, -3.0))
    query = image_edges(CAMERA, look(true)[1])
    found = search_edges(query, [pose((0.2, 0.0, 0.0), (0.0, 4.0, 0.0))], lambda _: keyframes, OPTIONS)
    distance, angle = pose_error(found[0].world_from_camera, true)
    assert distance < 0.01
    assert angle < 0.2
    assert found[0].hit > 0.9
    assert found[0].explained > 0.9
    assert sigmas(covariance_of(found[0]))[0] < 0.15


def test_what_lies_far_worse_is_not_finished_and_yet_measured_as_what_is() -> None:
    keyframes = [placed(pose((0.2 * k, 0.0, 0.0), (0.0, 4.0 * k, 0.0))) for k in range(2)]
    query, aside = image_edges(CAMERA, look(np.eye(4))[1]), pose((0.1, 0.0, 0.0), (0.0, 0.0, 0.0))
    options = replace(OPTIONS, coarse=(EdgeRound(20, 0.8, 4, 0, 5),), far_less=0.01)
    best, far = search_edges(query, [np.eye(4), aside], lambda _: keyframes, options)
    np.testing.assert_array_equal(far.world_from_camera, aside)
    as_others = measure_edges(query, keyframes, aside, OPTIONS.fine[-1])
    assert as_others is not None
    assert (far.seen, far.hit) == (as_others.seen, as_others.hit)  # of every point
    assert best.hit > far.hit


def test_edges_that_are_bright_on_the_other_side_are_others() -> None:
    keyframe = placed(np.eye(4))
    there, turned = look(np.eye(4))[1], look(np.eye(4), shades=SHADES[::-1])[1]
    same, other = (
        measure_edges(image_edges(CAMERA, grey), [keyframe], np.eye(4), OPTIONS.fine[-1]) for grey in (there, turned)
    )
    assert same is not None
    assert other is not None
    assert same.hit > 0.95
    assert other.hit < 0.05
    assert other.explained > 0.95  # there are edges, but others


def test_a_single_line_leaves_the_pose_free() -> None:
    floor = PLANES[:2]
    keyframes = [placed(pose((0.2 * k, 0.0, 0.0), (0.0, 4.0 * k, 0.0)), floor) for k in range(2)]
    query = image_edges(CAMERA, look(pose((0.05, 0.0, 0.05), (0.0, 2.0, 0.0)), floor)[1])
    fit = fit_edges(query, keyframes, np.eye(4), OPTIONS.fine)
    assert fit is not None
    assert sigmas(covariance_of(fit))[0] > 0.3


def test_what_stands_before_an_edge_hides_it() -> None:
    behind = placed(np.eye(4))
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 400), np.linspace(-1, 1, 400)), axis=-1).reshape(-1, 2)
    cover = np.column_stack([grid, np.ones(len(grid))])
    wall = PlacedEdges(2, np.eye(4), SpaceEdges(np.zeros((0, 3)), np.zeros((0, 3)), cover))
    query = image_edges(CAMERA, look(np.eye(4))[1])
    assert measure_edges(query, [behind, wall], np.eye(4), OPTIONS.fine[-1]) is None


def test_without_edges_there_is_no_pose() -> None:
    flat = np.full((240, 320), 80, np.uint8)
    assert space_edges(CAMERA, np.ones((240, 320), np.float32), flat) is None
    assert space_edges(CAMERA, np.full((240, 320), np.nan, np.float32), look(np.eye(4))[1]) is None
    assert search_edges(image_edges(CAMERA, flat), [np.eye(4)], lambda _: [], OPTIONS) == []


def test_a_distorted_lens_changes_nothing() -> None:
    grey = look(np.eye(4))[1]
    straight = image_edges(CAMERA, grey)
    bent = image_edges(Camera(320, 240, 262, 262, 159.5, 119.5, (0.05, -0.02)), grey)
    tiny = image_edges(Camera(320, 240, 262, 262, 159.5, 119.5, (1e-9,)), grey)
    assert not np.array_equal(straight.strength, bent.strength)
    np.testing.assert_allclose(straight.strength, tiny.strength, atol=1e-3)


@pytest.mark.parametrize("width", [640, 1280])
def test_large_images_are_looked_at_at_one_size(width: int) -> None:
    camera = Camera(width, width * 3 // 4, float(width), float(width), width / 2 - 0.5, width * 3 / 8 - 0.5)
    grey = np.zeros((width * 3 // 4, width), np.uint8)
    grey[:, width // 2 :] = 120
    edges = image_edges(camera, grey)
    assert edges.strength.shape == (480, 640)
    columns = np.flatnonzero(edges.clear.any(axis=0))
    at = columns + edges.offset[240, columns] * edges.along_x[240, columns]
    np.testing.assert_allclose(at, 319.5, atol=0.1)
    np.testing.assert_allclose(edges.intrinsics, [640, 640, 319.5, 239.5])
