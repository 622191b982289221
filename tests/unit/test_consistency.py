"""Which closures can be true together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semdb.geometry import invert_pose, pose_from, so3_exp
from semdb.trajectory.consistency import Chain, chain_of, consistent
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState, stack_edges
from semdb.trajectory.pieces import brought_together, components_of, held_of
from semdb.trajectory.pose_graph import optimise
from tests.unit.graph_samples import Walk, closures, walk, wrong_closures


def states(edges: list[Edge]) -> list[EdgeState]:
    return [edge.state for edge in edges]


@pytest.mark.parametrize("seed", range(4))
def test_right_closures_are_accepted(seed: int) -> None:
    sample = walk(seed=seed)
    judged = consistent(closures(sample, 40, seed), sample.chain)
    assert states(judged) == [EdgeState.ACCEPTED] * 40


@pytest.mark.parametrize("seed", range(4))
def test_as_many_wrong_ones_change_nothing(seed: int) -> None:
    """Half of all closures are wrong: none counts, all right ones do, and the poses are the same bit by bit."""
    sample = walk(seed=seed)
    right, wrong = closures(sample, 40, seed), wrong_closures(sample, 40, seed)
    judged = consistent([*right, *wrong], sample.chain)
    assert states(judged[:40]) == [EdgeState.ACCEPTED] * 40
    assert states(judged[40:]) == [EdgeState.CONTRADICTED] * 40

    def solved(edges: list[Edge]) -> bytes:
        counted = [edge for edge in edges if edge.state is EdgeState.ACCEPTED]
        held = np.arange(len(sample.true)) == 0
        return optimise(sample.odometry, stack_edges([*sample.edges, *counted]), held).poses.tobytes()

    assert solved(judged) == solved(consistent(right, sample.chain))


def test_a_wrong_one_is_named_with_what_it_contradicts() -> None:
    sample = walk()
    right = closures(sample, 20)
    near = replace(
        right[7], first_from_second=right[7].first_from_second @ pose_from(so3_exp([0, 0.2, 0]), [0.3, 0, 0])
    )
    judged = consistent([*right, near], sample.chain)[-1]
    assert judged.state is EdgeState.CONTRADICTED
    count = int(judged.reason.split()[-3])
    assert judged.reason in (f"contradicts {count} of 20", f"contradicts the odometry and {count} of 20")
    assert count >= 3


def test_what_failed_stays_failed() -> None:
    sample = walk()
    failed = replace(closures(sample, 1)[0], state=EdgeState.FAILED, reason="seen one way only")
    assert consistent([failed], sample.chain) == [failed]


def test_a_single_closure_must_agree_with_odometry() -> None:
    sample = walk()
    [right] = closures(sample, 1)
    [wrong] = wrong_closures(sample, 1)
    assert consistent([right], sample.chain)[0].state is EdgeState.ACCEPTED
    judged = consistent([wrong], sample.chain)[0]
    assert judged.state is EdgeState.CONTRADICTED
    assert judged.reason == "contradicts the odometry"


def two_pieces(sample: Walk) -> tuple[Chain, list[int]]:
    """The walk torn into two in the middle; the second piece has a world of its own."""
    half = len(sample.true) // 2
    moved = pose_from(so3_exp([0.3, -0.2, 1.0]), [4.0, -2.0, 1.0])
    poses = sample.odometry.copy()
    poses[half:] = moved @ invert_pose(poses[half]) @ poses[half:]
    pieces = [0] * half + [1] * (len(sample.true) - half)
    return chain_of(poses, pieces, sample.steps), pieces


def test_pieces_are_joined_by_two_that_agree() -> None:
    sample = walk()
    chain, pieces = two_pieces(sample)
    between = [replace(edge, kind=EdgeKind.SESSION) for edge in closures(sample, 6)]
    judged = consistent(between, chain)
    assert states(judged) == [EdgeState.ACCEPTED] * 6
    assert set(components_of(pieces, judged)) == {0}
    together = brought_together(chain.poses, pieces, judged)
    true = sample.odometry[0] @ invert_pose(sample.true[0]) @ sample.true
    assert np.linalg.norm(together[:, :3, 3] - true[:, :3, 3], axis=1).max() < 0.6  # the drift of odometry is left
    assert held_of(components_of(pieces, judged)).tolist() == [True] + [False] * (len(pieces) - 1)


def test_one_closure_joins_no_pieces() -> None:
    sample = walk()
    chain, pieces = two_pieces(sample)
    judged = consistent([replace(closures(sample, 1)[0], kind=EdgeKind.SESSION)], chain)
    assert states(judged) == [EdgeState.CONTRADICTED]
    assert judged[0].reason == "only 1 of 1 between these pieces agree"
    assert set(components_of(pieces, judged)) == {0, 1}
    assert held_of(components_of(pieces, judged)).sum() == 2


def test_pieces_are_not_joined_by_a_minority() -> None:
    sample = walk()
    chain, _ = two_pieces(sample)
    between = [replace(edge, kind=EdgeKind.SESSION) for edge in (*closures(sample, 3), *wrong_closures(sample, 40))]
    half = len(sample.true) // 2
    between = [edge for edge in between if edge.first < half <= edge.second]
    assert len(between) > 8
    assert EdgeState.ACCEPTED not in states(consistent(between, chain))


def test_a_thousand_closures_take_no_minute() -> None:
    sample = walk(700)
    judged = consistent([*closures(sample, 300), *wrong_closures(sample, 300)], sample.chain)
    assert sum(edge.state is EdgeState.ACCEPTED for edge in judged[:300]) >= 297
    assert EdgeState.ACCEPTED not in states(judged[300:])
