"""What several keyframes say of how far recorded poses are off, and what of it an answer counts with."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.localization.recorded_errors import (
    USUAL,
    AtQuery,
    at_query,
    pooled,
    recorded_sigma,
    shrunk,
    weighted,
)
from semdb.types import PoseErrors

QUERY = AtQuery(nearest=(0.8, 0.8), position_m=0.005, rotation_rad=0.002, turn_rad=0.01)


def test_keyframes_count_by_how_many_numbers_they_determine() -> None:
    found = pooled([PoseErrors(0.003, 0.002, 1.0, 8.0), PoseErrors(0.009, 0.006, 3.0, 0.0)])
    assert found.position_m == pytest.approx(np.sqrt((0.003**2 + 3 * 0.009**2) / 4))
    assert found.rotation_rad == pytest.approx(0.002)
    assert (found.position_freedom, found.rotation_freedom, found.keyframes) == (4.0, 8.0, 2)
    assert pooled([]) == PoseErrors(0.0, 0.0, 0.0, 0.0, 0)


def test_what_is_usual_counts_where_little_is_known() -> None:
    assert shrunk(None, []).position_m == pytest.approx(USUAL.position_m)
    little, much = PoseErrors(0.0003, 0.0002, 4.0, 4.0), PoseErrors(0.0003, 0.0002, 200.0, 200.0)
    assert shrunk(None, [little]).position_m == pytest.approx((USUAL.position_m**2 * 0.0003) ** (1 / 3))
    assert 0.0003 < shrunk(None, [much]).position_m < 0.00035
    assert shrunk(None, [PoseErrors(0.0, 0.0, 200.0, 200.0)]).position_m < 2e-5


def test_recordings_share_by_the_pairs_of_their_keyframes() -> None:
    one, other = PoseErrors(0.008, 0.005, 90.0, 60.0, 12), PoseErrors(0.002, 0.001, 30.0, 30.0, 12)
    found = weighted([one, None, other, one], [60, 20, 10, 10])
    assert [(round(item.position_freedom, 6), item.position_m) for item in found] == [(63.0, 0.008), (3.0, 0.002)]
    assert weighted([None], [5]) == []


def test_errors_grow_with_the_distance_and_the_turn_of_the_query() -> None:
    far_off, exact = PoseErrors(0.008, 0.0055, 90.0, 60.0), PoseErrors(0.0003, 0.0002, 90.0, 60.0)
    metres, radians = recorded_sigma(far_off, QUERY)
    assert 0.003 < metres < 0.02
    assert 0.002 < radians < 0.01
    further = recorded_sigma(far_off, AtQuery((1.6, 1.6), QUERY.position_m, QUERY.rotation_rad, QUERY.turn_rad))
    assert 1.2 < further[0] / metres < 2
    assert 1.2 < further[1] / radians < 2
    turning = recorded_sigma(far_off, AtQuery(QUERY.nearest, QUERY.position_m, QUERY.rotation_rad, 0.05))
    assert turning[0] > metres
    assert turning[1] > radians
    assert recorded_sigma(exact, QUERY)[0] < 1e-4
    assert recorded_sigma(exact, QUERY)[1] < 3e-4


def test_errors_beyond_those_of_the_fit_count_in_proportion() -> None:
    still = AtQuery(QUERY.nearest, QUERY.position_m, QUERY.rotation_rad, 0.0)
    metres = [recorded_sigma(PoseErrors(of, 0.005, 90.0, 60.0), still)[0] for of in (0.008, 0.016, 0.032, 0.08)]
    assert metres[1] / metres[0] == pytest.approx(8.0)
    assert metres[2] / metres[1] == pytest.approx(2.0)
    assert metres[3] / metres[1] == pytest.approx(5.0)


def test_sigma_of_a_query_is_along_an_axis() -> None:
    covariance = np.diag([1e-4, 4e-4, 4e-4, 1e-6, 1e-6, 4e-6])
    query = at_query(covariance, (0.5, 0.6), np.array([0.0, 0.03, 0.04]))
    assert (query.position_m, query.rotation_rad) == pytest.approx((np.sqrt(3e-4), np.sqrt(2e-6)))
    assert (query.nearest, query.turn_rad) == ((0.5, 0.6), pytest.approx(0.05))
