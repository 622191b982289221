"""Where a recording lies in a map: what localizing its keyframes claims, which claims agree, and the poses that follow.

Each localized keyframe claims a motion of the recording's world into the map's. Claims agree as closures between two
pieces of a trajectory do (`consistency`); the largest set in which all agree counts if it is large enough, if no other
one rivals it, and if most of what should see the same as the map does. Then one pose graph has the recording's own
steps, and the localizations as ties to the map's keyframes, which are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.geometry import invert_pose, pose_distances
from semdb.geometry.stacks import invert_poses, so3_logs
from semdb.trajectory.consistency import Chain, ConsistencyOptions, chain_of, largest_agreeing
from semdb.trajectory.edges import Edge, EdgeArrays, EdgeKind, EdgeState, stack_edges
from semdb.trajectory.pose_graph import marginal_covariances, optimise
from semdb.types import BoolArray, FloatArray

MEDIANS = ("confidence", "likeness")  # of claims


@dataclass(frozen=True, slots=True)
class StepNoise:
    """Standard deviations of a step from keyframe to keyframe: at rest, and what each metre and radian adds."""

    m: float
    m_per_m: float
    rad: float
    rad_per_rad: float


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """What convinces, and how stiff a trajectory is.

    `recorded` is how far recorded poses are off from step to step where the graph is solved, `drift` those that were
    estimated, and what is granted to any when claims are compared. `least_agreeing` claims must agree, half of them
    with a confidence of `sure` and patches that are `alike`, and `rival_share` times as many as in any other set. Of
    keyframes that should see the same as one of the map from about the same side (within `near`, `pose_distances`, and
    with `near_view` in common), `least_share` must be among them and look the same, where there are `least_near` of
    them: the likeness of patches is at least `like`, and `like_falls` less at a distance of 1. A room with other
    textures or furniture is localized from where it was seen before, and does not look the same from there.
    """

    least_agreeing: int = 3
    sure: float = 0.95
    alike: float = 0.65
    like: float = 0.9
    like_falls: float = 0.3
    rival_share: float = 2.0
    near: float = 1.0
    near_view: float = 0.5
    least_near: int = 4
    least_share: float = 0.5
    recorded: StepNoise = StepNoise(0.0005, 0.003, 0.0002, 0.001)  # turns are what localizations know least
    drift: StepNoise = StepNoise(0.003, 0.02, 0.003, 0.02)
    claim_growth: float = 2.0  # of standard deviations of localizations, in the pose graph
    claim_m: float = 0.004  # which are believed to be no surer than that
    claim_rad: float = 0.002
    consistency: ConsistencyOptions = field(default_factory=ConsistencyOptions)


@dataclass(frozen=True, slots=True, eq=False)
class Claim:
    """Keyframe `number` of the recording, localized in the map: `map_from_camera` ``[4, 4]``, and how sure that is.

    `covariance` ``[6, 6]`` is of left perturbations in the map, as localizations have it; `anchor` is the number of the
    map's keyframe that it agrees with most.
    """

    number: int
    anchor: int
    map_from_camera: FloatArray
    covariance: FloatArray
    inliers: int
    confidence: float = 1.0
    likeness: float = 1.0  # of the patches that it shares with the map's keyframes


@dataclass(frozen=True, slots=True, eq=False)
class Consensus:
    """Which claims agree. `map_from_recording` ``[4, 4]`` is that of the one in their middle; None without any."""

    edges: tuple[Edge, ...]  # of each claim, from the map's keyframe to the recording's; states say which count
    agreeing: tuple[int, ...]  # numbers of the recording's keyframes
    confidence: float  # medians over those
    likeness: float
    rival: int  # claims of the largest other set
    map_from_recording: FloatArray | None


def claim_edges(claims: Sequence[Claim], map_poses: FloatArray, offset: int) -> list[Edge]:
    """Each claim as an edge from a map's keyframe to number ``offset + claim.number``."""
    edges = []
    for claim in claims:
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = claim.map_from_camera[:3, :3].T
        information = np.linalg.inv(turn @ claim.covariance @ turn.T)
        edges.append(
            Edge(
                first=claim.anchor,
                second=offset + claim.number,
                kind=EdgeKind.SESSION,
                first_from_second=invert_pose(map_poses[claim.anchor]) @ claim.map_from_camera,
                information=(information + information.T) / 2,
                inliers=claim.inliers,
            )
        )
    return edges


def agree(
    claims: Sequence[Claim],
    map_poses: FloatArray,
    poses: FloatArray,
    steps: FloatArray,
    options: SessionOptions | None = None,
) -> Consensus:
    """Which of `claims` can be true together, for keyframes at `poses` ``[n, 4, 4]`` in the recording's world.

    `map_poses` ``[m, 4, 4]`` are those of the map; `steps` ``[n, 6, 6]`` covariances of each keyframe against the one
    before it (`step_covariances`).
    """
    options = options or SessionOptions()
    count = len(map_poses)
    edges = claim_edges(claims, map_poses, count)
    chain = _chain(map_poses, poses, steps)
    agreeing, pairs = largest_agreeing(edges, chain, options.consistency)
    others = [edge for n, edge in enumerate(edges) if n not in agreeing]
    rival = len(largest_agreeing(others, chain, options.consistency)[0])
    for n in set(range(len(edges))) - set(agreeing):
        against = int(np.count_nonzero(~pairs[n, agreeing]))
        reason = f"contradicts {against} of {len(agreeing)}"
        edges[n] = replace(edges[n], state=EdgeState.CONTRADICTED, reason=reason)
    middle, confidence, likeness = None, 0.0, 0.0
    if agreeing:
        kept = [claims[n] for n in agreeing]
        confidence, likeness = (float(np.median([getattr(one, name) for one in kept])) for name in MEDIANS)
        motions = np.stack([claims[n].map_from_camera @ invert_pose(poses[claims[n].number]) for n in agreeing])
        at = poses[[claims[n].number for n in agreeing], :3, 3].mean(axis=0)
        middle = _middle(motions, at)
    return Consensus(tuple(edges), tuple(claims[n].number for n in agreeing), confidence, likeness, rival, middle)


def _chain(map_poses: FloatArray, poses: FloatArray, steps: FloatArray) -> Chain:
    """The map, which does not drift, and the recording as two pieces."""
    still = np.zeros((len(map_poses), 6, 6))
    pieces = [0] * len(map_poses) + [1] * len(poses)
    return chain_of(np.concatenate([map_poses, poses]), pieces, np.concatenate([still, steps]))


def _middle(motions: FloatArray, at: FloatArray) -> FloatArray:
    """The one of `motions` ``[k, 4, 4]`` that is nearest to all others, where they move the point `at`."""
    moved = motions.copy()
    moved[:, :3, 3] += motions[:, :3, :3] @ at
    total = [float(pose_distances(one, moved).sum()) for one in moved]
    return np.asarray(motions[int(np.argmin(total))])


def step_covariances(poses: FloatArray, noise: StepNoise) -> FloatArray:
    """How far each of `poses` ``[n, 4, 4]`` may be off against the one before: right perturbations ``[n, 6, 6]``."""
    found = np.zeros((len(poses), 6, 6))
    for n in range(1, len(poses)):
        found[n] = _step_covariance(invert_pose(poses[n - 1]) @ poses[n], noise)
    return found


def _step_covariance(step: FloatArray, noise: StepNoise) -> FloatArray:
    metres = noise.m + noise.m_per_m * float(np.linalg.norm(step[:3, 3]))
    turn = float(np.linalg.norm(so3_logs(step[None, :3, :3])[0]))
    radians = noise.rad + noise.rad_per_rad * turn
    return np.diag(np.repeat([metres**2, radians**2], 3))


def looks_the_same(likeness: float, distance: float, options: SessionOptions) -> bool:
    """Whether a keyframe so far (`pose_distances`) from one of the map looks as the same place does."""
    return likeness >= options.like - options.like_falls * distance


def convinces(
    consensus: Consensus, near: Sequence[int], same: Sequence[int], options: SessionOptions | None = None
) -> str:
    """Why the map is not where the recording lies, in a line; empty where it is.

    `near` are numbers of keyframes that should see the same as a keyframe of the map, once both are in one frame, and
    `same` those of them that are among the claims that agree, and look the same.
    """
    options = options or SessionOptions()
    agreeing, claims = len(consensus.agreeing), len(consensus.edges)
    if not claims:
        return "none of its keyframes is localized there"
    if agreeing < options.least_agreeing:
        return f"only {agreeing} of {claims} localized keyframes agree where it lies; it takes {options.least_agreeing}"
    if consensus.confidence < options.sure or consensus.likeness < options.alike:
        return (
            f"{agreeing} keyframes agree where it lies, but are not sure of it: the median of their confidence is "
            f"{consensus.confidence:.2f} ({options.sure:g} is asked), of the likeness of what they see "
            f"{consensus.likeness:.2f} ({options.alike:g})"
        )
    if agreeing < options.rival_share * consensus.rival:
        return f"two places fit: {agreeing} keyframes agree on one, {consensus.rival} on another"
    if len(near) >= options.least_near and len(same) < options.least_share * len(near):
        return (
            f"{agreeing} keyframes agree where it lies, but of {len(near)} that should look the same as the map there, "
            f"only {len(same)} do"
        )
    return ""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Poses in the map's frame with covariances against it (left perturbations), and how well claims fit them."""

    poses: FloatArray  # [n, 4, 4]
    covariances: FloatArray  # [n, 6, 6]
    map_poses: FloatArray  # [m, 4, 4] as they were, unless they were free
    map_covariances: FloatArray  # [m, 6, 6] zero where held


def place(
    consensus: Consensus,
    map_poses: FloatArray,
    poses: FloatArray,
    links: EdgeArrays,
    map_links: EdgeArrays | None = None,
    options: SessionOptions | None = None,
) -> Placed:
    """The recording's keyframes in the map.

    `links` tie `poses` ``[n, 4, 4]`` to each other by number (steps, closures). With `map_links`, which tie those of
    the map to each other, these are free too, but for the first.
    """
    options = options or SessionOptions()
    if consensus.map_from_recording is None:
        raise ValueError("nothing agrees where the recording lies")
    count = len(map_poses)
    ties = stack_edges([edge for edge in consensus.edges if edge.state is EdgeState.ACCEPTED])
    ties = replace(ties, information=_doubted(ties.information, options))
    start = np.concatenate([map_poses, consensus.map_from_recording @ poses])
    parts = [_shifted(links, count), ties] + ([] if map_links is None else [map_links])
    edges = EdgeArrays(
        first=np.concatenate([part.first for part in parts]),
        second=np.concatenate([part.second for part in parts]),
        first_from_second=np.concatenate([part.first_from_second for part in parts]),
        information=np.concatenate([part.information for part in parts]),
        robust=np.concatenate([part.robust for part in parts]),
    )
    held: BoolArray = np.zeros(len(start), np.bool_)
    held[: count if map_links is None else 1] = True
    solved = optimise(start, edges, held).poses
    spread = _in_world(marginal_covariances(solved, edges, held), solved)
    return Placed(solved[count:], spread[count:], solved[:count], spread[:count])


def _shifted(links: EdgeArrays, by: int) -> EdgeArrays:
    return replace(links, first=links.first + by, second=links.second + by)


def _doubted(information: FloatArray, options: SessionOptions) -> FloatArray:
    """Localizations of neighbours are wrong alike, so that they say less together than each does alone."""
    spread = np.linalg.inv(information) * options.claim_growth**2
    spread[:, np.arange(6), np.arange(6)] += np.repeat([options.claim_m**2, options.claim_rad**2], 3)
    return np.linalg.inv(spread)


def _in_world(spread: FloatArray, poses: FloatArray) -> FloatArray:
    """Covariances of right perturbations as those of left ones, of translation and rotation."""
    turn = np.zeros((len(poses), 6, 6))
    turn[:, :3, :3] = turn[:, 3:, 3:] = poses[:, :3, :3]
    found = turn @ spread @ np.swapaxes(turn, 1, 2)
    return (found + np.swapaxes(found, 1, 2)) / 2


def chain_links(poses: FloatArray, steps: FloatArray) -> EdgeArrays:
    """The step from each of `poses` ``[n, 4, 4]`` to the next as edges; `steps` ``[n, 6, 6]`` as in `agree`."""
    first = np.arange(max(len(poses) - 1, 0), dtype=np.int32)
    relative = invert_poses(poses[:-1]) @ poses[1:]
    information = np.asarray(np.linalg.inv(steps[1:]), np.float64)
    return EdgeArrays(first, first + 1, relative, information, np.zeros(len(first), np.bool_))
