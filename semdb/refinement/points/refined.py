"""Refined points of the keyframes of a map: from pairs that see the same things to a depth for every keypoint.

The work goes in blocks of keyframes, each with its neighbours, so that memory is bounded and time grows with the
number of keyframes. Within a block: match pairs at their known poses, join matches to tracks, lay every two keyframes
of a track on each other, solve each keypoint's depth. All is a function of the keyframes in their order.
"""

from __future__ import annotations

import itertools
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose
from semdb.geometry.volumes import Volume, neighbour_pairs
from semdb.localization.tracks import join_tracks, pairs_of_tracks
from semdb.localization.views import View
from semdb.refinement.points.depths import Observations, solve_depths
from semdb.refinement.points.matching import match_known_poses, match_whole_images
from semdb.refinement.points.options import FusionOptions
from semdb.refinement.points.registration import Sightings, register
from semdb.types import Float32Array, FloatArray, Int64Array, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPoints:
    """Points of one keyframe: of which keypoints ``[m]``, and float32 ``[m, 4]``: X, Y, Z (camera frame), sigma of Z.

    `fused` of them were measured in the keyframe too, `triangulated` were not.
    """

    keypoints: IntArray
    points: Float32Array
    fused: int
    triangulated: int


class _Views:
    """Views of keyframes by their number, the latest kept."""

    def __init__(self, load: Callable[[int], View], capacity: int) -> None:
        self._load = load
        self._capacity = capacity
        self._kept: OrderedDict[int, View] = OrderedDict()

    def of(self, number: int) -> View:
        if number not in self._kept:
            self._kept[number] = self._load(number)
            if len(self._kept) > self._capacity:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]


@dataclass(frozen=True, slots=True, eq=False)
class _Nodes:
    """Keypoints of the keyframes of a block, one after the other."""

    frames: tuple[int, ...]  # numbers of the keyframes, ascending
    start: Int64Array  # [f + 1]
    frame_of: IntArray  # [n] place in `frames`
    xy: FloatArray  # [n, 2]
    depth: FloatArray  # [n]


def refine_points(
    volumes: Sequence[Volume],
    load: Callable[[int], View],
    options: FusionOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[int, RefinedPoints]]:
    """Refined points of keyframes 0, 1, ... that have any; `progress` counts keyframes.

    `volumes` are what they see, `load` gives the view of one, with all its keypoints, whether they have a point or not.
    """
    options = options or FusionOptions()
    if not volumes:
        return
    pairs = neighbour_pairs(list(volumes), options.neighbours, options.least_share, options.candidates)
    views = _Views(load, 2 * options.block)
    for first in range(0, len(volumes), options.block):
        core = range(first, min(first + options.block, len(volumes)))
        own = [pair for pair in pairs if pair[0] in core or pair[1] in core]
        yield from _refine_block(core, own, volumes, views, options, progress)


def _refine_block(
    core: range,
    pairs: Sequence[tuple[int, int]],
    volumes: Sequence[Volume],
    views: _Views,
    options: FusionOptions,
    progress: Callable[[int, int], None] | None,
) -> Iterator[tuple[int, RefinedPoints]]:
    poses = [volume.world_from_camera for volume in volumes]
    nodes = _gather(sorted({number for pair in pairs for number in pair}), views)
    place = {number: at for at, number in enumerate(nodes.frames)}
    matched: list[tuple[Int64Array, Int64Array, Float32Array]] = []
    laid: dict[tuple[int, int], FloatArray] = {}
    done = core.start
    for i, j in pairs:
        one, two, distance, laid[i, j] = _match(views.of(i), views.of(j), invert_pose(poses[j]) @ poses[i], options)
        matched.append((one + nodes.start[place[i]], two + nodes.start[place[j]], distance))
        if progress is not None and i in core and i > done:
            done = i
            progress(done, len(volumes))
    if matched:
        joined = tuple(np.concatenate(columns) for columns in zip(*matched, strict=True))
        pairs_seen = pairs_of_tracks(*join_tracks(joined[0], joined[1], joined[2], nodes.frame_of))
        yield from _solve(core, nodes, pairs_seen, poses, laid, views, options)
    if progress is not None:
        progress(core.stop, len(volumes))


def _match(
    first: View, second: View, recorded: FloatArray, options: FusionOptions
) -> tuple[IntArray, IntArray, Float32Array, FloatArray]:
    """Keypoints of both, distances of their descriptors, and the pose ``[4, 4]`` between the two that they suggest."""
    one, two = match_whole_images(first, second, recorded, options.gate)
    laid = register(_sightings(first, one), _sightings(second, two), recorded, second.focal, options.registration)
    least, most = options.gate.least_px / second.focal, options.gate.most_px / second.focal
    gate = float(np.clip(3 * laid.noise, least, most))
    return *match_known_poses(first, second, laid.second_from_first, gate, options.gate), laid.second_from_first


def _sightings(view: View, rows: IntArray) -> Sightings:
    return Sightings(view.xy[rows], view.points[rows, 2].astype(np.float64))


def _gather(numbers: Sequence[int], views: _Views) -> _Nodes:
    xy, depth, sizes = [np.zeros((0, 2))], [np.zeros(0)], []
    for number in numbers:
        view = views.of(number)
        xy.append(view.xy)
        depth.append(view.points[:, 2].astype(np.float64))
        sizes.append(len(view))
    start = np.r_[0, np.cumsum(sizes)].astype(np.int64)
    frame_of = np.repeat(np.arange(len(numbers), dtype=np.int32), sizes)
    return _Nodes(tuple(numbers), start, frame_of, np.concatenate(xy), np.concatenate(depth))


def _solve(
    core: range,
    nodes: _Nodes,
    pairs: tuple[Int64Array, Int64Array],
    poses: Sequence[FloatArray],
    laid: Mapping[tuple[int, int], FloatArray],
    views: _Views,
    options: FusionOptions,
) -> Iterator[tuple[int, RefinedPoints]]:
    """Depths of the core's keypoints that are in a track. `pairs` are all ordered pairs of nodes of one track."""
    focals = [views.of(number).focal for number in nodes.frames]
    observations, keypoints = _observations(core, nodes, pairs, poses, laid, focals, options)
    found = solve_depths(observations, options.depths)
    good = np.isfinite(found.depth) & (found.agreeing >= options.depths.least_agreeing)
    keypoints, depth, sigma = keypoints[good], found.depth[good], found.sigma[good]
    bounds = np.searchsorted(keypoints, nodes.start)
    for at, number in enumerate(nodes.frames):
        rows = slice(bounds[at], bounds[at + 1])
        if number not in core or bounds[at] == bounds[at + 1]:
            continue
        view = views.of(number)
        own = keypoints[rows]
        ray = np.column_stack([nodes.xy[own], np.ones(len(own))])
        points = np.column_stack([ray * depth[rows, None], sigma[rows]]).astype(np.float32)
        measured = int(np.isfinite(nodes.depth[own]).sum())
        yield number, RefinedPoints(view.source[own - nodes.start[at]], points, measured, len(own) - measured)


def _observations(
    core: range,
    nodes: _Nodes,
    pairs: tuple[Int64Array, Int64Array],
    poses: Sequence[FloatArray],
    laid: Mapping[tuple[int, int], FloatArray],
    focals: Sequence[float],
    options: FusionOptions,
) -> tuple[Observations, Int64Array]:
    """What is seen of each keypoint of the core, and these keypoints (nodes, ascending)."""
    one, two = pairs
    a, b = nodes.frame_of[one], nodes.frame_of[two]
    in_core = np.isin(np.array(nodes.frames), np.array(core))
    keep = (a < b) & (in_core[a] | in_core[b])  # each two keyframes are laid on each other once
    one, two, a, b = one[keep], two[keep], a[keep], b[keep]
    order = np.lexsort((two, one, b, a))
    one, two, a, b = one[order], two[order], a[order], b[order]
    edges = np.flatnonzero(np.r_[True, (a[1:] != a[:-1]) | (b[1:] != b[:-1]), True]) if len(a) else np.zeros(0, int)
    moves: list[FloatArray] = []
    noise: list[float] = []
    which: list[IntArray] = []
    owner: list[Int64Array] = []
    seen: list[Int64Array] = []
    for begin, end in itertools.pairwise(edges):  # of what two keyframes see both
        own, other = one[begin:end], two[begin:end]
        first, second = nodes.frames[a[begin]], nodes.frames[b[begin]]
        found = register(
            Sightings(nodes.xy[own], nodes.depth[own]),
            Sightings(nodes.xy[other], nodes.depth[other]),
            invert_pose(poses[second]) @ poses[first],
            focals[b[begin]],
            options.registration,
            laid.get((first, second)),
        )
        for inside, keypoint, seen_as, pose in (
            (first in core, own, other, found.second_from_first),
            (second in core, other, own, invert_pose(found.second_from_first)),
        ):
            if inside:
                which.append(np.full(len(keypoint), len(moves), np.int32))
                owner.append(keypoint)
                seen.append(seen_as)
                moves.append(pose)
                noise.append(found.noise)
    if not moves:
        empty = np.zeros(0, np.int64)
        which, owner, seen, moves, noise = [empty.astype(np.int32)], [empty], [empty], [np.eye(4)], [1.0]
    keypoint, by = np.concatenate(owner), np.concatenate(seen)
    order = np.lexsort((by, keypoint))
    keypoint, by = keypoint[order], by[order]
    keypoints, start = np.unique(keypoint, return_index=True)
    stacked = np.stack(moves)
    return (
        Observations(
            ray=nodes.xy[keypoints],
            depth=nodes.depth[keypoints],
            start=np.r_[start, len(keypoint)].astype(np.int64),
            which=np.concatenate(which)[order],
            rotation=np.ascontiguousarray(stacked[:, :3, :3]),
            translation=np.ascontiguousarray(stacked[:, :3, 3]),
            noise=np.array(noise),
            seen=nodes.xy[by],
            seen_depth=nodes.depth[by],
        ),
        keypoints,
    )
