"""Where a recording lies in a map, from made-up localizations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.trajectory.edges import EdgeState
from semdb.trajectory.sessions import (
    Claim,
    Consensus,
    SessionOptions,
    agree,
    chain_links,
    convinces,
    looks_the_same,
    place,
    step_covariances,
)
from semdb.types import FloatArray

COVARIANCE = np.diag(np.repeat([0.005**2, 0.003**2], 3))
DRIFT = SessionOptions().drift
MOTION = pose_from(so3_exp([0.3, -1.2, 0.4]), [4.0, -2.0, 1.0])  # map from recording
ELSEWHERE = pose_from(so3_exp([0.3, -1.2, 0.4]), [6.0, -2.0, 1.0])


def walk(count: int, seed: int) -> FloatArray:
    """A camera that goes around a room."""
    random = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    places = np.stack([2 * np.cos(angle), 2 * np.sin(angle), 1.2 + 0.1 * random.normal(size=count)], axis=1)
    return np.stack([pose_from(so3_exp([0, 0, a]), p) for a, p in zip(angle, places, strict=True)])


def noisy(pose: FloatArray, random: np.random.Generator) -> FloatArray:
    return pose_from(so3_exp(random.normal(0, 0.003, 3)) @ pose[:3, :3], pose[:3, 3] + random.normal(0, 0.005, 3))


def claims_of(truth: FloatArray, chosen: Sequence[int], anchors: FloatArray, seed: int = 0) -> list[Claim]:
    random = np.random.default_rng(seed)
    found = []
    for number in chosen:
        anchor = int(np.argmin(np.linalg.norm(anchors[:, :3, 3] - truth[number, :3, 3], axis=1)))
        found.append(Claim(number, anchor, noisy(truth[number], random), COVARIANCE, 100))
    return found


@pytest.fixture
def scene() -> tuple[FloatArray, FloatArray, FloatArray]:
    """The map's keyframes, those of the recording in the map, and in a world of its own."""
    own = walk(20, 1)
    return walk(12, 2), MOTION @ own, own


def test_what_agrees_is_found_among_wrong_claims(scene: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    anchors, truth, own = scene
    claims = claims_of(truth, range(0, 20, 2), anchors)
    wrong = claims_of(ELSEWHERE @ own, [1, 5], anchors)
    random = np.random.default_rng(5)
    wild = [
        Claim(n, 0, pose_from(so3_exp(random.normal(size=3)), random.normal(0, 3, 3)), COVARIANCE, 30) for n in (3, 7)
    ]
    found = agree([*claims, *wrong, *wild], anchors, own, step_covariances(own, DRIFT))
    assert found.agreeing == tuple(range(0, 20, 2))
    assert found.rival == 2
    assert [edge.state for edge in found.edges] == [EdgeState.ACCEPTED] * 10 + [EdgeState.CONTRADICTED] * 4
    assert found.edges[-1].reason == "contradicts 10 of 10"
    assert convinces(found, [], []) == ""
    placed = place(found, anchors, own, chain_links(own, step_covariances(own, DRIFT)))
    errors = [pose_error(one, two) for one, two in zip(placed.poses, truth, strict=True)]
    assert np.median([metres for metres, _ in errors]) < 0.006
    assert max(metres for metres, _ in errors) < 0.015
    assert max(degrees for _, degrees in errors) < 0.5
    np.testing.assert_array_equal(placed.map_poses, anchors)
    np.testing.assert_array_equal(placed.map_covariances, 0.0)
    sigma = np.sqrt(np.einsum("nii->ni", placed.covariances[:, :3, :3]))
    assert (sigma > 0.001).all()
    assert (sigma < 0.02).all()


def test_a_trajectory_that_drifted_is_bent(scene: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    anchors, truth, own = scene
    drift = pose_from(so3_exp([0, 0, 0.004]), [0.004, 0.0, 0.0])  # of each step: 8 cm and 4.6 degrees in all
    bent = own.copy()
    for n in range(1, len(own)):
        bent[n] = bent[n - 1] @ invert_pose(own[n - 1]) @ own[n] @ drift
    claims = claims_of(truth, range(20), anchors)
    found = agree(claims, anchors, bent, step_covariances(bent, DRIFT))
    assert len(found.agreeing) >= 15
    placed = place(found, anchors, bent, chain_links(bent, step_covariances(bent, DRIFT)))
    assert np.median([pose_error(a, b)[0] for a, b in zip(placed.poses, truth, strict=True)]) < 0.01


def test_with_a_free_map_both_give_way(scene: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    anchors, truth, own = scene
    found = agree(claims_of(truth, range(20), anchors), anchors, own, step_covariances(own, DRIFT))
    map_links = chain_links(anchors, step_covariances(anchors, DRIFT))
    placed = place(found, anchors, own, chain_links(own, step_covariances(own, DRIFT)), map_links)
    np.testing.assert_array_equal(placed.map_poses[0], anchors[0])
    moved = np.linalg.norm(placed.map_poses[1:, :3, 3] - anchors[1:, :3, 3], axis=1)
    assert (moved > 0).all()
    assert (moved < 0.03).all()
    assert (np.einsum("nii->n", placed.map_covariances[1:]) > 0).all()


def test_too_few_and_two_places_do_not_convince(scene: tuple[FloatArray, FloatArray, FloatArray]) -> None:
    anchors, truth, own = scene
    steps = step_covariances(own, DRIFT)
    two = agree(claims_of(truth, [0, 9], anchors), anchors, own, steps)
    assert convinces(two, [], []) == "only 2 of 2 localized keyframes agree where it lies; it takes 3"
    assert convinces(agree([], anchors, own, steps), [], []) == "none of its keyframes is localized there"
    both = [*claims_of(truth, range(0, 12), anchors), *claims_of(ELSEWHERE @ own, range(12, 20), anchors)]
    assert (
        convinces(agree(both, anchors, own, steps), [], []) == "two places fit: 12 keyframes agree on one, 8 on another"
    )
    half = [*claims_of(truth, range(0, 10), anchors), *claims_of(ELSEWHERE @ own, range(10, 20), anchors)]
    assert convinces(agree(half, anchors, own, steps), [], []).startswith("two places fit: 10 ")
    good = agree(claims_of(truth, range(5), anchors), anchors, own, steps)
    assert convinces(good, [0, 1, 2, 7], [0, 2]) == ""
    assert convinces(good, [0, *range(6, 16)], [0]) == (
        "5 keyframes agree where it lies, but of 11 that should look the same as the map there, only 1 do"
    )
    for doubt in ({"confidence": 0.9}, {"likeness": 0.5}):
        doubtful = [replace(claim, **doubt) for claim in claims_of(truth, range(5), anchors)]
        why = convinces(agree([*doubtful, *claims_of(truth, [7], anchors)], anchors, own, steps), [], [])
        assert why.startswith("6 keyframes agree where it lies, but are not sure of it: the median of their confidence")
    options = SessionOptions()
    assert looks_the_same(0.91, 0.0, options)
    assert not looks_the_same(0.89, 0.0, options)
    assert looks_the_same(0.61, 1.0, options)


def test_nothing_is_placed_where_nothing_agrees() -> None:
    with pytest.raises(ValueError, match="nothing agrees"):
        place(
            Consensus((), (), 0.0, 0.0, 0, None),
            walk(3, 0),
            walk(3, 1),
            chain_links(walk(3, 1), step_covariances(walk(3, 1), DRIFT)),
        )
