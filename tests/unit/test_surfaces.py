"""A query's depth laid on surfaces: exact in a corner, honest on a bare wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import pose_error, so3_exp
from semdb.localization.confidence import sigmas
from semdb.localization.surface_alignment import (
    PlacedSurfaces,
    Round,
    SurfaceFit,
    SurfaceOptions,
    distinct,
    fit_surfaces,
    place,
)
from semdb.localization.surface_search import search_surfaces
from semdb.localization.surface_step import covariance_of
from semdb.localization.surfaces import surfaces_of
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

CAMERA = Camera(320, 240, 262.0, 262.0, 159.5, 119.5)
PLANES = (  # normals and offsets of a corner of a room: floor, two walls
    (np.array([0.0, -1.0, 0.0]), 0.7),
    (np.array([0.0, 0.0, -1.0]), 3.0),
    (np.array([-0.8, 0.0, -0.6]), 2.6),
)
WALL = PLANES[1:2]
OPTIONS = SurfaceOptions()


def pose(shift: tuple[float, float, float], turn_deg: tuple[float, float, float]) -> FloatArray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = so3_exp(np.radians(turn_deg)), shift
    return made


def look(world_from_camera: FloatArray, planes=PLANES, paint: float = 0.0) -> tuple[Float32Array, ImageArray]:
    """Depth and grey values of planes; `paint` is how strong a pattern on them is."""
    v, u = np.mgrid[:240, :320].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=-1)
    world = rays @ world_from_camera[:3, :3].T
    depth, grey = np.full(u.shape, np.inf), np.zeros(u.shape)
    for number, (normal, offset) in enumerate(planes):
        at = (-offset - world_from_camera[:3, 3] @ normal) / (world @ normal)
        points = world_from_camera[:3, 3] + at[..., None] * world
        shade = 90 + 40 * number + paint * np.sin(points @ [5.0, 7.0, 6.0])
        nearer = (at > 0) & (at < depth)
        depth, grey = np.where(nearer, at, depth), np.where(nearer, shade, grey)
    return np.where(np.isfinite(depth), depth, np.nan).astype(np.float32), np.clip(grey, 0, 255).astype(np.uint8)


def placed(world_from_camera: FloatArray, planes=PLANES, paint: float = 0.0) -> PlacedSurfaces:
    surfaces = surfaces_of(CAMERA, *look(world_from_camera, planes, paint))
    assert surfaces is not None
    return place(1, surfaces, world_from_camera)


def test_points_and_normals_are_those_of_the_planes() -> None:
    there = pose((0.1, 0.0, 0.0), (3.0, 8.0, 0.0))
    found = placed(there)
    for points, normals in zip(found.points, found.normals, strict=True):
        off = np.abs(np.stack([points @ normal + offset for normal, offset in PLANES]))
        which = off.argmin(axis=0)
        assert np.quantile(off.min(axis=0), 0.99) < 0.004
        along = np.einsum("ij,ij->i", normals, np.stack([PLANES[k][0] for k in which]))
        assert np.quantile(along, 0.06) > 0.999


@pytest.mark.parametrize("paint", [0.0, 30.0])
def test_a_corner_gives_the_pose_to_the_millimetre(paint: float) -> None:
    keyframes = [placed(pose((0.2 * k, 0.0, 0.0), (0.0, 4.0 * k, 0.0)), paint=paint) for k in range(3)]
    true = pose((0.25, -0.1, 0.1), (4.0, 10.0, -3.0))
    query = surfaces_of(CAMERA, *look(true, paint=paint))
    assert query is not None
    [fit] = search_surfaces(query, [pose((0.2, 0.0, 0.0), (0.0, 4.0, 0.0))], lambda _: keyframes, OPTIONS)
    distance, angle = pose_error(fit.world_from_camera, true)
    assert distance < 0.002
    assert angle < 0.05
    assert fit.near > 0.98
    assert fit.through < 0.01
    sigma_m, sigma_deg = sigmas(covariance_of(fit))
    assert sigma_m < 0.02
    assert sigma_deg < 0.5


def test_a_distorted_lens_changes_nothing() -> None:
    """Surfaces are those of the image without distortion."""
    straight = surfaces_of(CAMERA, *look(np.eye(4)))
    bent = surfaces_of(Camera(320, 240, 262, 262, 159.5, 119.5, (0.05, -0.02)), *look(np.eye(4)))
    assert straight is not None
    assert bent is not None
    assert not np.allclose(straight[0].depth, bent[0].depth, equal_nan=True)
    tiny = surfaces_of(Camera(320, 240, 262, 262, 159.5, 119.5, (1e-9,)), *look(np.eye(4)))
    assert tiny is not None
    np.testing.assert_allclose(straight[0].depth, tiny[0].depth, atol=1e-6)


def test_a_bare_wall_leaves_the_pose_free_along_it() -> None:
    keyframes = [placed(pose((0.2 * k, 0.0, 0.0), (0.0, 4.0 * k, 0.0)), WALL) for k in range(2)]
    query = surfaces_of(CAMERA, *look(pose((0.05, 0.0, 0.05), (0.0, 2.0, 0.0)), WALL))
    assert query is not None
    [fit] = search_surfaces(query, [np.eye(4)], lambda _: keyframes, OPTIONS)
    covariance = covariance_of(fit)
    assert np.sqrt(covariance[2, 2]) < 0.01  # towards the wall
    assert sigmas(covariance)[0] > 0.3  # along it


def test_without_overlap_there_is_no_pose() -> None:
    query = surfaces_of(CAMERA, *look(np.eye(4)))
    assert query is not None
    behind = pose((0.0, 0.0, 0.0), (0.0, 180.0, 0.0))
    assert search_surfaces(query, [behind], lambda _: [placed(np.eye(4))], OPTIONS) == []
    assert surfaces_of(CAMERA, np.full((240, 320), np.nan, np.float32), np.zeros((240, 320), np.uint8)) is None


def test_what_lies_far_worse_is_not_finished_and_yet_measured_as_what_is() -> None:
    keyframes = [placed(pose((0.2 * k, 0.0, 0.0), (0.0, 4.0 * k, 0.0)), paint=30.0) for k in range(2)]
    query = surfaces_of(CAMERA, *look(np.eye(4), paint=30.0))
    assert query is not None
    still = (Round(1, 0.30, 0.02, 0, 5), Round(1, 0.15, 0.01, 0, 5))
    aside = pose((0.0, 0.0, 0.1), (0.0, 0.0, 0.0))
    best, far = search_surfaces(
        query, [np.eye(4), aside], lambda _: keyframes, replace(OPTIONS, coarse=still, far_less=0.01)
    )
    np.testing.assert_array_equal(far.world_from_camera, aside)
    as_others = fit_surfaces(query, keyframes, aside, (replace(OPTIONS.fine[-1], steps=0),), OPTIONS)
    roughly = fit_surfaces(query, keyframes, aside, still, OPTIONS)
    assert as_others is not None
    assert roughly is not None
    assert (far.seen, far.near, far.through) == (as_others.seen, as_others.near, as_others.through)
    assert far.through > roughly.through + 0.1  # whose bounds are wider
    assert best.near > 0.98


def fit_at(shift: float, near: float = 0.9, through: float = 0.0) -> SurfaceFit:
    return SurfaceFit(
        pose((shift, 0, 0), (0, 0, 0)), np.eye(6) * 1e7, np.zeros((6, 6)), 1000, near, 0.9, 0.0, through, 0.9, 0.5
    )


def test_fits_of_one_pose_are_one() -> None:
    groups = distinct([fit_at(0.0, 0.8), fit_at(1.0), fit_at(0.01, 0.85)])
    assert [[fit.near for fit in group] for group in groups] == [[0.9], [0.85, 0.8]]
