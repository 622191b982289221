"""Descriptor matching: mutual, ratio, classes as evidence, guided."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.localization.matching import (
    Evidence,
    MatchingOptions,
    _in_both,
    closeness,
    distance_of,
    match_guided,
    match_keypoints,
)
from semdb.localization.matching_kernels import count_near, multiply, scan, scan_all, two_least

RANDOM = np.random.default_rng(0)


def unit_rows(count: int, width: int = 64) -> np.ndarray:
    rows = RANDOM.normal(size=(count, width))
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def squared_distances(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return distance_of(closeness(first, second), first.dtype)


def background(count: int) -> np.ndarray:
    return np.full(count, -1, np.int32)


def test_distances_of_unit_vectors_and_of_bits() -> None:
    a, b = unit_rows(5), unit_rows(7)
    expected = ((a[:, None] - b[None]) ** 2).sum(axis=2)
    np.testing.assert_allclose(squared_distances(a, b), expected, atol=1e-5)
    bits = RANDOM.integers(0, 256, (4, 32), dtype=np.uint8)
    other = bits.copy()
    other[0, 0] ^= 0b101
    assert squared_distances(bits, other)[0, 0] == 2
    assert squared_distances(bits, other)[1, 1] == 0


def test_a_shuffled_copy_is_found_again() -> None:
    query = unit_rows(200)
    order = RANDOM.permutation(200)
    matches = match_keypoints(query, query[order], background(200), background(200))
    assert len(matches) == 200
    np.testing.assert_array_equal(order[matches.keyframe], matches.query)
    assert not matches.same_class.any()


def test_nothing_to_match() -> None:
    assert len(match_keypoints(unit_rows(0), unit_rows(5), background(0), background(5))) == 0
    assert len(match_keypoints(unit_rows(5), unit_rows(0), background(5), background(0))) == 0
    assert len(match_keypoints(unit_rows(1), unit_rows(1), background(1), background(1))) <= 1


def test_repeated_texture_fails_the_ratio_unless_the_class_decides() -> None:
    """The same pattern on a cup and on the wall: only among keypoints on cups is it unique."""
    pattern = unit_rows(1)
    other = unit_rows(6)
    query = np.vstack([pattern, other[:3]])
    keyframe = np.vstack([pattern + 0.01 * unit_rows(1), pattern + 0.01 * unit_rows(1), other[3:]])
    keyframe /= np.linalg.norm(keyframe, axis=1, keepdims=True)
    query_classes = np.array([0, 0, -1, -1], np.int32)
    keyframe_classes = np.array([0, -1, 0, 0, -1], np.int32)
    unaware = match_keypoints(query, keyframe, background(4), background(5))
    aware = match_keypoints(query, keyframe, query_classes, keyframe_classes)
    assert 0 not in unaware.query
    pairs = list(zip(aware.query.tolist(), aware.keyframe.tolist(), strict=True))
    assert (0, 0) in pairs
    assert aware.same_class[pairs.index((0, 0))]


def test_contradicting_classes_need_a_better_match() -> None:
    query = unit_rows(1)
    near = query + 0.08 * unit_rows(1)
    far = query + 0.1 * unit_rows(1)  # ratio of distances about 0.8: between the two limits
    keyframe = np.vstack([near, far]).astype(np.float32)
    keyframe /= np.linalg.norm(keyframe, axis=1, keepdims=True)
    first, second = sorted(np.sqrt(squared_distances(query, keyframe)[0]))
    assert 0.75 < first / second < 0.85
    table, cup, wall = np.array([0], np.int32), np.array([1, 1], np.int32), background(2)
    assert len(match_keypoints(query, keyframe, table, wall)) == 1
    assert len(match_keypoints(query, keyframe, table, cup)) == 0


def test_objects_only_never_leaves_the_class() -> None:
    query = unit_rows(60)
    classes = np.array([0, 1, -1] * 20, np.int32)
    options = MatchingOptions(evidence=Evidence.OBJECTS)
    matches = match_keypoints(query, query, classes, classes, options)
    assert len(matches) == 40
    assert (classes[matches.query] == classes[matches.keyframe]).all()
    assert (classes[matches.query] >= 0).all()


@pytest.mark.parametrize("kind", ["float32", "uint8"])
def test_guided_matching_looks_near_the_projection_only(kind: str) -> None:
    descriptors = unit_rows(50) if kind == "float32" else RANDOM.integers(0, 256, (50, 32), dtype=np.uint8)
    xy = RANDOM.uniform(0, 600, (50, 2))
    repeated = np.concatenate([descriptors, descriptors])  # everything is there twice, once 300 px away
    twice_xy = np.concatenate([xy, xy + 300.0])
    shifted = xy + 3.0
    classes = background(50)
    matches = match_guided(repeated, descriptors, twice_xy, shifted, background(100), classes)
    found = dict(zip(matches.keyframe.tolist(), matches.query.tolist(), strict=True))
    assert len(found) >= 45
    assert all(found[k] == k for k in found)
    nowhere = np.full((50, 2), np.nan)
    assert len(match_guided(repeated, descriptors, twice_xy, nowhere, background(100), classes)) == 0
    away = match_guided(repeated, descriptors, twice_xy, xy + 5000, background(100), classes)
    assert len(away) == 0


def test_only_keypoints_of_equal_sign_match() -> None:
    query = unit_rows(80)
    signs = np.where(np.arange(80) % 2 == 0, 1, -1).astype(np.int8)
    everything = match_keypoints(query, query, background(80), background(80), query_signs=signs, keyframe_signs=signs)
    np.testing.assert_array_equal(everything.query, np.arange(80))
    np.testing.assert_array_equal(everything.keyframe, np.arange(80))
    turned = np.where(np.arange(80) < 20, -signs, signs).astype(np.int8)
    some = match_keypoints(query, query, background(80), background(80), query_signs=signs, keyframe_signs=turned)
    assert (signs[some.query] == turned[some.keyframe]).all()
    assert set(range(20, 80)) <= set(some.query.tolist())
    xy = RANDOM.uniform(0, 600, (80, 2))
    near = match_guided(query, query, xy, xy, background(80), background(80), query_signs=signs, keyframe_signs=turned)
    assert (signs[near.query] == turned[near.keyframe]).all()
    assert len(near) >= 60


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(0, 30), m=st.integers(0, 30), depth=st.integers(1, 20))
def test_products_are_those_of_numpy(seed: int, n: int, m: int, depth: int) -> None:
    random = np.random.default_rng(seed)
    first, second = random.normal(size=(n, depth)).astype(np.float32), random.normal(size=(depth, m)).astype(np.float32)
    found = np.full((n, m), np.nan, np.float32)
    multiply(first, second, found)
    np.testing.assert_allclose(found, first @ second, atol=1e-5)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 30), m=st.integers(1, 30))
def test_scan_is_a_search_of_all(seed: int, n: int, m: int) -> None:
    random = np.random.default_rng(seed)
    close = random.integers(0, 500, (40, 40)).astype(np.float32)  # some are equal
    before = close.copy()
    rows = np.sort(random.permutation(40)[:n]).astype(np.int32)
    columns = np.sort(random.permutation(40)[:m]).astype(np.int32)
    block = close[np.ix_(rows, columns)]
    for whole in (False, True):
        nearest, best, second, back = np.empty(n, np.int32), *(np.empty(k, np.float32) for k in (n, n, m))
        if whole:
            scan_all(block.copy(), nearest, best, second, back)
        else:
            scan(close, rows, columns, nearest, best, second, back)
        np.testing.assert_array_equal(close, before)
        np.testing.assert_array_equal(nearest, block.argmax(axis=1))
        np.testing.assert_array_equal(best, block.max(axis=1))
        np.testing.assert_array_equal(back, block.max(axis=0))
        expected = np.sort(block, axis=1)[:, -2] if m > 1 else np.full(n, np.float32(-1e38))
        np.testing.assert_array_equal(second, expected)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), m=st.integers(1, 60), radius=st.floats(0.5, 40))
def test_near_pairs_are_those_of_a_search_of_all(seed: int, n: int, m: int, radius: float) -> None:
    random = np.random.default_rng(seed)
    a, b = random.uniform(0, 100, (n, 2)), random.uniform(0, 100, (m, 2))
    i, j = np.empty(n * m, np.int32), np.empty(n * m, np.int32)
    signs, others = random.integers(0, 2, n).astype(np.int8), random.integers(0, 2, m).astype(np.int8)
    found = count_near(
        a[:, 0].copy(), a[:, 1].copy(), signs, np.argsort(a[:, 0]), b[:, 0].copy(), b[:, 1].copy(), others, radius, i, j
    )
    within = ((a[:, None] - b[None]) ** 2).sum(axis=2) <= radius**2
    near = np.argwhere(within & (signs[:, None] == others[None]))
    assert sorted(zip(i[:found].tolist(), j[:found].tolist(), strict=True)) == sorted(map(tuple, near.tolist()))
    values = random.random(found).astype(np.float32)
    least, second = np.full(n, np.inf, np.float32), np.full(n, np.inf, np.float32)
    two_least(values, i[:found], least, second)
    for group in range(n):
        own = np.sort(values[i[:found] == group])
        assert least[group] == (own[0] if len(own) else np.inf)
        assert second[group] == (own[1] if len(own) > 1 else np.inf)


@pytest.mark.parametrize("columns", [1, 2, 127, 128, 129, 300])
def test_the_two_greatest_of_rows_and_the_greatest_of_columns(columns: int) -> None:
    """Whatever block of columns they are in, and of equal ones the first."""
    random = np.random.default_rng(columns)
    close = random.integers(-50, 50, (40, columns)).astype(np.float32)  # many are equal
    nearest, best, second = np.empty(40, np.int32), np.empty(40, np.float32), np.empty(40, np.float32)
    best_back = np.empty(columns, np.float32)
    kept = close.copy()
    scan_all(close, nearest, best, second, best_back)
    np.testing.assert_array_equal(close, kept)
    np.testing.assert_array_equal(nearest, close.argmax(axis=1))
    np.testing.assert_array_equal(best, close.max(axis=1))
    np.testing.assert_array_equal(best_back, close.max(axis=0))
    expected = np.sort(close, axis=1)[:, -2] if columns > 1 else np.full(40, -1.0e38, np.float32)
    np.testing.assert_array_equal(second, expected)


@settings(max_examples=60, deadline=None)
@given(
    first=st.lists(st.integers(-1, 6) | st.sampled_from([-3, 5000]), max_size=12),
    second=st.lists(st.integers(-1, 6) | st.sampled_from([-3, 5000]), max_size=12),
)
def test_numbers_of_both_are_those_of_sets(first: list[int], second: list[int]) -> None:
    found = _in_both(np.array(first, np.int32), np.array(second, np.int32))
    assert found == sorted(set(first) & set(second))
