"""From the closures that are found to one world: which of them count, and where they put the keyframes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from semdb.trajectory.closures import ClosureSearch
from semdb.trajectory.consistency import chain_of, consistent
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.measuring import judged, measured_again
from semdb.trajectory.odometry import Odometry
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.pieces import brought_together, components_of
from semdb.trajectory.solving import Sharing, Solution, solve_graph
from semdb.trajectory.ties import ties

Progress = Callable[[int, int], None]


def close_loops(
    odometry: Odometry, search: ClosureSearch, options: TrajectoryOptions, progress: Progress | None = None
) -> tuple[list[Edge], Solution]:
    """Closures in rounds: by how keyframes look, then by where they are thought to be; and the pose graph with them."""
    keyframes = odometry.keyframes
    pieces = [keyframe.piece for keyframe in keyframes.all]
    start = np.array(keyframes.poses).reshape(-1, 4, 4)
    edges, solution = list(odometry.edges), Solution(start, pieces)
    if not options.close_loops or len(keyframes) < 2:
        return edges, solution
    chain = chain_of(start, pieces, np.array(odometry.steps).reshape(-1, 6, 6))
    refused: dict[tuple[int, int], str] = {}
    for done in range(options.closures.rounds):
        search.look(_wanted(search.near(solution.components), edges, options) if done else search.alike(), progress)
        while True:
            closures = _without(consistent(search.edges, chain, options.consistency), pieces, refused)
            edges = [*odometry.edges, *closures]
            accepted = [edge for edge in edges if _counts(edge)]
            together = brought_together(start, pieces, accepted)
            solution = solve_graph(together, components_of(pieces, accepted), accepted)
            keyframes.move(solution.poses)
            doubts = _doubtful(search, pieces, closures, options)
            if not doubts:
                break
            refused |= doubts
    return edges, solution


def _wanted(
    pairs: Sequence[tuple[int, int]], edges: Sequence[Edge], options: TrajectoryOptions
) -> list[tuple[int, int]]:
    """Those of `pairs` in which a keyframe has not got `enough` closures yet."""
    counts: dict[int, int] = {}
    for edge in edges:
        if edge.kind is not EdgeKind.ODOMETRY and _counts(edge):
            for end in (edge.first, edge.second):
                counts[end] = counts.get(end, 0) + 1
    return [pair for pair in pairs if min(counts.get(end, 0) for end in pair) < options.closures.enough]


def _doubtful(
    search: ClosureSearch, pieces: Sequence[int], closures: Sequence[Edge], options: TrajectoryOptions
) -> dict[tuple[int, int], str]:
    """Pieces that closures join, though most of what should look the same in both does not; and why.

    Two rooms may be alike in places. Once they are laid on each other, keyframes that see the same place from about the
    same side are known, and of one room nearly all of them are verified.
    """
    joined = sorted({_pieces_of(edge, pieces) for edge in closures if edge.kind is EdgeKind.SESSION and _counts(edge)})
    found = {}
    for one, two in joined:
        members = [[n for n, piece in enumerate(pieces) if piece == which] for which in (one, two)]
        pairs, expected = search.side_by_side(*members)
        search.look(pairs)
        verified = sum(search.verified(pair) for pair in pairs)
        if len(pairs) >= options.closures.side_least and verified < expected:
            found[one, two] = f"only {verified} of {len(pairs)} keyframes that should look the same do"
    return found


def _without(closures: Sequence[Edge], pieces: Sequence[int], refused: Mapping[tuple[int, int], str]) -> list[Edge]:
    """`closures`, those between `refused` pieces contradicted."""
    return [
        replace(edge, state=EdgeState.CONTRADICTED, reason=refused[_pieces_of(edge, pieces)])
        if _counts(edge) and _pieces_of(edge, pieces) in refused
        else edge
        for edge in closures
    ]


def _pieces_of(edge: Edge, pieces: Sequence[int]) -> tuple[int, int]:
    one, two = pieces[edge.first], pieces[edge.second]
    return min(one, two), max(one, two)


def edges_after_adjustment(
    edges: Sequence[Edge],
    odometry: Odometry,
    search: ClosureSearch,
    solution: Solution,
    sharings: Sequence[Sharing],
    options: TrajectoryOptions,
) -> list[Edge]:
    """`edges` measured again at the adjusted keyframes, and closures that these show in addition."""
    sights = {**odometry.sights, **search.sights}
    again = measured_again(edges, sights, odometry.keyframes, solution, options)
    if not options.close_loops:
        return again
    closed = {_pair(edge) for edge in again if edge.kind is not EdgeKind.ODOMETRY and _counts(edge)}
    pairs = set(search.near(solution.components)) - closed
    found = [judged(edge, solution, options) for edge in ties(sharings, pairs, odometry.keyframes, solution, options)]
    found = [edge for edge in found if _counts(edge)]
    replaced = {_pair(edge) for edge in found}
    return [edge for edge in again if edge.kind is EdgeKind.ODOMETRY or _pair(edge) not in replaced] + found


def _counts(edge: Edge) -> bool:
    return edge.state is EdgeState.ACCEPTED


def _pair(edge: Edge) -> tuple[int, int]:
    return min(edge.first, edge.second), max(edge.first, edge.second)
