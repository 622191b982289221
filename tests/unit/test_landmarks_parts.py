"""Parts of the computation of landmarks: clusters, boxes, evidence of classes, masks to points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.geometry import so3_exp
from semdb.landmarks.boxes import Box, intersection_over_union, shared_area, upright_axes, upright_box
from semdb.landmarks.clustering import clusters
from semdb.landmarks.evidence import fuse, name_probabilities
from semdb.landmarks.lift import SeenObject, apart, lift_keyframe, same_masks
from semdb.types import Camera

UP = np.array([0.0, 0.0, 1.0])


def joined(count: int, edges: list[tuple[int, int, int]]) -> list[int]:
    a, b, w = (np.array(column, np.int64) for column in zip(*edges, strict=True))
    return clusters(count, a, b, w).tolist()


def test_what_speaks_against_keeps_two_things_apart_though_a_third_links_them() -> None:
    chain = [(0, 1, 5000), (1, 2, 4000)]
    assert joined(3, chain) == [0, 0, 0]
    assert joined(3, [*chain, (0, 2, -12000)]) == [0, 0, 2]


def test_of_equal_links_the_one_of_the_first_sightings_counts() -> None:
    assert joined(3, [(1, 2, 3000), (0, 1, 3000), (0, 2, -9000)]) == [0, 0, 2]


@given(st.integers(0, 2**32 - 1))
def test_the_order_of_links_does_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    edges = [(int(a), int(b), int(w)) for a, b, w in rng.integers((0, 0, -9000), (10, 10, 9000), (30, 3))]
    mixed = [(b, a, w) if w % 2 else (a, b, w) for a, b, w in rng.permutation(edges).tolist()]
    assert joined(10, edges) == joined(10, mixed)


def box(centre: tuple[float, float, float], size: tuple[float, float, float], yaw: float = 0.0) -> Box:
    return Box(np.array(centre), np.array(size), so3_exp([0, 0, yaw]))


def test_intersection_over_union_of_upright_boxes() -> None:
    one = box((0, 0, 0), (2, 1, 1))
    assert intersection_over_union(one, one) == pytest.approx(1)
    assert intersection_over_union(one, box((1, 0, 0), (2, 1, 1))) == pytest.approx(1 / 3)
    assert intersection_over_union(one, box((0, 0, 0.5), (2, 1, 1))) == pytest.approx(1 / 3)
    assert intersection_over_union(one, box((0, 0, 0), (2, 1, 1), np.pi / 2)) == pytest.approx(1 / 3)
    assert intersection_over_union(one, box((3, 0, 0), (2, 1, 1))) == 0


@given(st.floats(-3, 3), st.floats(0, 2 * np.pi), st.floats(0.2, 2), st.floats(0.2, 2))
def test_shared_area_is_symmetric_and_no_larger_than_either(x: float, yaw: float, w: float, d: float) -> None:
    one, other = box((0, 0, 0), (1, 1, 1)), box((x, 0.1, 0), (w, d, 1), yaw)
    first, second = one.corners[:4, :2], other.corners[:4, :2]
    area = shared_area(first, second)
    assert area == pytest.approx(shared_area(second, first), abs=1e-9)
    assert -1e-9 <= area <= min(1.0, w * d) + 1e-9


@pytest.mark.parametrize("yaw", [0.0, 0.3, 1.2])
def test_two_faces_of_a_refrigerator_give_its_box(yaw: float) -> None:
    rng = np.random.default_rng(0)
    face = np.column_stack([rng.uniform(-0.35, 0.35, 800), np.full(800, -0.35), rng.uniform(0, 1.7, 800)])
    side = np.column_stack([np.full(800, 0.35), rng.uniform(-0.35, 0.35, 800), rng.uniform(0, 1.7, 800)])
    turn = so3_exp([0, 0, yaw])
    found = upright_box(np.concatenate([face, side]) @ turn.T, UP)
    assert intersection_over_union(found, Box(turn @ [0, 0, 0.85], np.array([0.7, 0.7, 1.7]), turn)) > 0.95


def test_upright_axes_are_a_frame_for_any_up() -> None:
    for up in (UP, -UP, np.array([0.0, -1.0, 0.0]), np.array([1.0, 0.0, 0.0]), np.array([0.6, 0.0, 0.8])):
        axes = upright_axes(up)
        assert axes.T @ axes == pytest.approx(np.eye(3))
        assert np.linalg.det(axes) == pytest.approx(1)
        assert axes[:, 2] == pytest.approx(up)


def test_a_rare_name_of_another_class_does_not_win() -> None:
    # 85 % of what lies where a "bench" was seen is called chair, since there are no benches
    confusion = np.array([[0, 0.15, 0], [0.85, 0, 0], [0, 0, 0.0]])
    names = name_probabilities(3, confusion)
    assert names.sum(axis=1) == pytest.approx(1)
    chairs = fuse(np.array([0] * 17 + [1] * 3), np.full(20, 0.9), names)
    assert chairs.argmax() == 0
    assert chairs[0] > 0.99
    thin = fuse(np.array([0, 1]), np.array([0.9, 0.9]), names)
    assert thin[0] == pytest.approx(0.5, abs=0.01)


@given(st.permutations(list(range(6))))
def test_evidence_does_not_depend_on_its_order(order: list[int]) -> None:
    category, score = np.array([0, 1, 1, 2, 0, 1]), np.array([0.9, 0.4, 0.77, 0.61, 0.99, 0.5])
    names = name_probabilities(3)
    assert fuse(category[order], score[order], names).tolist() == fuse(category, score, names).tolist()


def square(u: int, v: int, size: int, shape: tuple[int, int] = (60, 80)) -> np.ndarray:
    mask = np.zeros(shape, bool)
    mask[v : v + size, u : u + size] = True
    return mask


def test_two_masks_of_one_thing_are_one_sighting() -> None:
    sighting, first = same_masks([square(10, 10, 20), square(40, 10, 10), square(11, 11, 20)], 0.5)
    assert sighting.tolist() == [0, 1, 0]
    assert first == [0, 1]


def test_masks_that_overlap_are_not_told_to_be_two_things() -> None:
    masks = [square(10, 10, 20), square(40, 10, 10), square(25, 10, 12)]
    found = apart(masks, np.array([m.sum() for m in masks]))
    assert found.tolist() == [[False, True, False], [True, False, True], [False, True, False]]


def test_points_lie_on_the_thing_and_its_rim_takes_the_depth_of_the_thing() -> None:
    camera = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
    depth = np.full((60, 80), 3.0, np.float32)
    depth[12:28, 12:28] = 1.0  # the thing; the mask takes in two pixels of the wall
    lifted = lift_keyframe(camera, np.eye(4), depth, [SeenObject(0, 0.9, square(10, 10, 20))])
    assert lifted.points[0][:, 2] == pytest.approx(1.0)
    assert lifted.outline[0][:, 2] == pytest.approx(1.0)
    assert np.ptp(lifted.outline[0][:, 0]) == pytest.approx(19 / 70, abs=0.02)
    assert lifted.grid_owner.max() == 1


def test_without_depth_nothing_has_a_place() -> None:
    camera = Camera(80, 60, 70.0, 70.0, 39.5, 29.5)
    lifted = lift_keyframe(camera, np.eye(4), None, [SeenObject(0, 0.9, square(10, 10, 20))])
    assert [len(points) for points in lifted.points] == [0]
