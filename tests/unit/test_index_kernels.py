"""The loops of the index against numpy, and the reduction of vectors."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.localization.index.cache_folder import first_to_merge
from semdb.localization.index.kernels import best_rows, class_sums, scan_codes
from semdb.localization.index.reduction import fit_reduction, sample_rows
from semdb.types import Float32Array


@settings(deadline=None)  # kernels are compiled at the first call
@given(classes=st.integers(1, 5), keyframes=st.integers(0, 40), terms=st.integers(0, 5), seed=st.integers(0, 10**6))
def test_sums_are_those_of_the_tables(classes: int, keyframes: int, terms: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    counts = random.integers(0, 256, (classes, keyframes + 3)).astype(np.uint8)
    rows = random.integers(0, classes, terms).astype(np.int64)
    tables = random.integers(0, 10**10, (terms, 256)).astype(np.int64)
    start = int(random.integers(0, keyframes + 1))
    out = np.full(keyframes + 3, -1, np.int64)
    class_sums(counts, rows, tables, start, keyframes, out)
    expected = sum((tables[t, counts[rows[t]]] for t in range(terms)), np.zeros(keyframes + 3, np.int64))
    assert out[start:keyframes].tolist() == expected[start:keyframes].tolist()
    assert (out[:start] == -1).all()
    assert (out[keyframes:] == -1).all()


def test_sums_of_more_than_a_block() -> None:
    random = np.random.default_rng(0)
    counts = random.integers(0, 3, (4, 10_000)).astype(np.uint8)
    tables = random.integers(0, 9, (3, 256)).astype(np.int64)
    out = np.zeros(10_000, np.int64)
    class_sums(counts, np.array([2, 0, 3]), tables, 0, 10_000, out)
    assert (out == tables[0][counts[2]] + tables[1][counts[0]] + tables[2][counts[3]]).all()


@settings(deadline=None)  # kernels are compiled at the first call
@given(
    scores=st.lists(st.integers(-3, 3), max_size=60),
    count=st.integers(0, 20),
    least=st.integers(-4, 4),
    dtype=st.sampled_from([np.int64, np.float32, np.float64]),
    seed=st.integers(0, 10**6),
)
def test_the_best_rows(scores: list[int], count: int, least: int, dtype: type[np.generic], seed: int) -> None:
    random = np.random.default_rng(seed)
    values = np.array(scores, dtype)
    ids = random.permutation(len(scores)).astype(np.int64)
    alive = random.random(len(scores)) < 0.8
    start = int(random.integers(0, len(scores) + 1))
    rows = np.empty(count, np.int64)
    found = best_rows(values, ids, alive, float(least), start, len(scores), rows)
    there = [row for row in range(start, len(scores)) if alive[row] and scores[row] >= least]
    expected = sorted(there, key=lambda row: (-scores[row], ids[row]))[:count]
    assert sorted(rows[:found].tolist()) == sorted(expected)


def test_scores_that_are_no_number_are_never_best() -> None:
    rows = np.empty(3, np.int64)
    scores = np.array([np.nan, 1.0, np.nan])
    assert best_rows(scores, np.arange(3), np.ones(3, np.bool_), -np.inf, 0, 3, rows) == 1
    assert rows[0] == 1


@settings(deadline=None)  # kernels are compiled at the first call
@given(count=st.integers(0, 30), size=st.integers(1, 70), seed=st.integers(0, 10**6))
def test_the_scan_is_an_inner_product(count: int, size: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    codes = random.integers(-127, 128, (count, size)).astype(np.int8)
    query = random.normal(size=size).astype(np.float32)
    out = np.empty(count, np.float32)
    scan_codes(codes, query, 0, count, out)
    expected = codes.astype(np.float64) @ query.astype(np.float64)
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-3 * size)


def vectors_on_a_plane(count: int, size: int, rank: int, seed: int) -> Float32Array:
    random = np.random.default_rng(seed)
    latent = random.normal(size=(count, rank)) * np.linspace(3, 1, rank)
    vectors = latent @ random.normal(size=(rank, size)) + random.normal(size=size)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors, np.float32)


def test_as_many_components_as_there_are_lose_only_the_rounding() -> None:
    vectors = vectors_on_a_plane(400, 64, 6, 1)
    reduction = fit_reduction(vectors, 8, 400)
    np.testing.assert_allclose(reduction.axes @ reduction.axes.T, np.eye(8), atol=1e-4)
    query = vectors_on_a_plane(1, 64, 6, 2)[0]
    scaled, constant = reduction.query(query)
    estimates = reduction.encode(vectors).astype(np.float64) @ scaled.astype(np.float64) + constant
    np.testing.assert_allclose(estimates, vectors @ query, atol=0.02)
    assert np.abs(estimates - vectors @ query).mean() < 0.004


def test_the_first_components_are_those_of_a_full_decomposition() -> None:
    vectors = vectors_on_a_plane(300, 40, 12, 3)
    reduction = fit_reduction(vectors, 5, 300)
    _, _, full = np.linalg.svd(vectors - vectors.mean(axis=0), full_matrices=False)
    np.testing.assert_allclose(np.abs(np.sum(full[:5] * reduction.axes, axis=1)), 1, atol=1e-3)
    again = fit_reduction(vectors, 5, 300)
    assert np.array_equal(reduction.axes, again.axes)
    assert np.array_equal(reduction.scales, again.scales)


@pytest.mark.parametrize(("count", "size", "components"), [(1, 8, 4), (3, 8, 16), (50, 2, 128)])
def test_fewer_vectors_or_numbers_than_components(count: int, size: int, components: int) -> None:
    vectors = vectors_on_a_plane(count, size, 2, 4)
    reduction = fit_reduction(vectors, components, count)
    assert reduction.encode(vectors).shape == (count, min(count, size, components))
    assert np.isfinite(reduction.scales).all()


def test_samples_are_spread_evenly() -> None:
    assert sample_rows(5, 10).tolist() == [0, 1, 2, 3, 4]
    assert sample_rows(101, 5).tolist() == [0, 25, 50, 75, 100]
    assert sample_rows(0, 5).tolist() == []


def test_small_files_are_merged_and_large_ones_left() -> None:
    assert first_to_merge([1_000_000, 10, 10]) == 1
    assert first_to_merge([1_000_000, 300, 100, 60, 50]) == 1
    assert first_to_merge([1000, 100, 10, 1]) == 2  # at least two files become one
    assert first_to_merge([5, 5, 5]) == 0
