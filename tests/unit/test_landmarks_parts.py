"""Parts of the computation of landmarks: clusters, boxes, evidence of classes, masks to points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.geometry import so3_exp
from semdb.geometry.sensor import depth_noise
from semdb.landmarks.boxes import Box, intersection_over_union, shared_area, upright_axes, upright_box
from semdb.landmarks.clustering import clusters, contract
from semdb.landmarks.evidence import fuse, name_probabilities, settled, support
from semdb.landmarks.kernels import joined_pixels
from semdb.landmarks.lift import SeenObject, apart, lift_keyframe, measured_noise, same_masks
from semdb.landmarks.sizes import sizes_of
from semdb.landmarks.visits import witness
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


def test_what_is_too_large_for_a_class_is_of_another_one() -> None:
    phones, barred = (np.array([0, 0, 0, 1]), np.full(4, 0.6)), np.array([[True, False, False]])
    nothing = np.full((1, 3), np.nan)
    assert settled([phones], nothing).argmax() == 0
    found = settled([phones], nothing, barred=barred)
    assert found.argmax() == 1
    assert found[0, 0] == 0
    alone = (phones[0][:3], phones[1][:3])  # no other name: it keeps that one, and is not confirmed
    assert settled([alone], nothing, barred=barred).tolist() == settled([alone], nothing).tolist()
    sizes = sizes_of(["cell phone", "chair", "of my own"])
    assert sizes.longest.tolist() == [0.3, np.inf, np.inf]
    assert sizes.too_large(np.array([[0.1, 0.4, 0.2], [0.1, 0.3, 0.2]])).tolist() == [[True, False, False], [False] * 3]


def test_support_is_the_highest_score_of_each_keyframe() -> None:
    found = support(np.array([0, 0, 1, 1, 2]), np.array([4, 4, 4, 5, 4]), np.array([0.3, 0.4, 0.25, 0.9, 0.2]))
    assert found == {4: 0.85, 5: 0.9}


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


def tilted(degrees: float, distance: float, camera: Camera) -> np.ndarray:
    """Depth ``[H, W]`` of a plane through the point `distance` ahead, turned away about the x axis."""
    v = np.arange(camera.height, dtype=np.float64)[:, None]
    y = np.broadcast_to((v - camera.cy) / camera.fy, (camera.height, camera.width))
    normal = np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
    return (distance * normal[2] / (normal[1] * y + normal[2])).astype(np.float32)


def test_noise_of_depth_is_measured() -> None:
    camera = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
    exact = tilted(50, 2.5, camera)
    assert measured_noise(camera, exact) < 0.02
    noisy = exact + np.random.default_rng(0).normal(0, depth_noise(exact)).astype(np.float32)
    assert 0.85 < measured_noise(camera, noisy) < 1.15
    assert measured_noise(camera, np.zeros_like(exact)) == 1.0  # nothing is known of it


@pytest.mark.parametrize("degrees", [0.0, 70.0])
def test_a_thing_of_three_centimetres_is_gone_from_its_table_however_flat_it_is_looked_at(degrees: float) -> None:
    camera = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)
    depth = tilted(degrees, 3.0, camera)
    across = np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])
    on_table = np.array([0.0, 0.0, 3.0])
    points = np.array([on_table, on_table - 0.03 * across, on_table + 0.03 * across])
    votes = np.zeros((3, 3), np.int32)
    lens = np.array([260.0, 260.0, 160.0, 120.0, 320, 240])
    witness(points, np.eye(4), lens, np.zeros(5), depth, 1.0, np.array([0.008, 0.5, 0.012, 0.9, 0.25]), votes)
    assert votes.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


def test_what_noise_adds_to_a_side_is_taken_off() -> None:
    rng = np.random.default_rng(1)
    back = np.column_stack([rng.uniform(-0.15, 0.15, 2000), np.zeros(2000), rng.uniform(0, 0.2, 2000)])
    noise = np.diag([0.0, 0.02**2, 0.0])
    seen = back + rng.normal(0, 0.02, (2000, 1)) * [0, 1, 0]
    assert upright_box(seen, UP, 0.01).size[:2].min() > 0.08
    found = upright_box(seen, UP, 0.01, noise=noise)
    assert found.size[:2].min() < 0.02
    assert found.size[:2].max() == pytest.approx(0.3, abs=0.01)
    assert found.size[2] == pytest.approx(0.2, abs=0.01)


def test_surfaces_are_followed_to_the_last_pixel() -> None:
    depth = np.full((20, 30), 2.0, np.float32)
    owner = np.zeros((20, 30), np.int16)
    owner[5:15, 5:15] = 1
    owner[5, 15:25] = 1  # a line of one pixel beside the rest
    depth[10:15, 14] = 3.0  # behind an edge
    inner = np.array([row * 30 + column for row in range(7, 13) for column in range(7, 13)])
    out = np.empty(600, np.int64)
    number = joined_pixels(depth, owner, 1, inner, len(inner), 0.015, 0.015, out)
    reached = np.zeros(600, np.bool_)
    reached[out[:number]] = True
    assert reached.reshape(20, 30)[5, 15:25].all()
    assert number == 110 - 5


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_parts_are_cut_each_for_itself_as_the_whole_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, edges = int(rng.integers(1, 24)), int(rng.integers(0, 60))
    a, b = rng.integers(0, count, (2, edges))
    weight = rng.integers(-4, 5, edges)
    kept = contract(range(count), a.tolist(), b.tolist(), weight.tolist())
    expected = np.arange(count)
    for node in range(count):
        expected[node] = node if kept[node] == node else expected[kept[node]]
    np.testing.assert_array_equal(clusters(count, a, b, weight), expected)
