"""Which keypoints of keyframes are one point: guided matching between keyframes that see the same, joined to tracks.

All sightings of a track are then aligned, patch by patch, to one of them: the pixels of a track do not carry the errors
of as many detections.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose, pixels_to_normalized, transform_points
from semdb.geometry.volumes import neighbour_pairs
from semdb.localization.adjustment import in_front
from semdb.localization.alignment import LEAST_LIKENESS, patch_steps, patch_warps
from semdb.localization.alignment_kernels import align_patches
from semdb.localization.bundle import pixel_sigma
from semdb.localization.matching import MatchingOptions, match_guided
from semdb.localization.tracks import join_tracks
from semdb.localization.views import View
from semdb.threads import each
from semdb.trajectory.adjustment import SharedPoints
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.options import TrajectoryOptions
from semdb.types import BoolArray, Float32Array, FloatArray, Int64Array, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _Nodes:
    """Keypoints of all keyframes, one after the other."""

    start: Int64Array  # [c + 1]
    frame: IntArray  # [n]
    xy: FloatArray  # [n, 2]
    seen: FloatArray  # [n, 2]
    points: FloatArray  # [n, 3] camera frame
    size: Float32Array  # [n]
    row: FloatArray  # [n]


def shared_points(
    keyframes: Keyframes,
    numbers: Sequence[int],
    poses: FloatArray,
    radius_px: float,
    options: TrajectoryOptions,
    far: Sequence[tuple[int, int]] = (),
) -> SharedPoints:
    """The points that the keyframes `numbers` share at `poses` ``[c, 4, 4]``; images count within `numbers`.

    Each is compared with its neighbours, and pairs (numbers) that are named `far` with each other.
    """
    views = [keyframes.all[n].view for n in numbers]
    volumes = [keyframes.volume(n, pose) for n, pose in zip(numbers, poses, strict=True)]
    chosen = options.adjustment
    pairs = neighbour_pairs(volumes, chosen.neighbours, chosen.least_share, chosen.candidates)
    place = {number: n for n, number in enumerate(numbers)}
    named = [(place[one], place[two]) for one, two in far if one in place and two in place]
    pairs = sorted({*pairs, *named})
    nodes = _nodes_of(views)

    def match(pair: tuple[int, int]) -> tuple[IntArray, IntArray, Float32Array]:
        i, j = pair
        return _match(views[i], views[j], poses[i], poses[j], radius_px, options.matching)

    matched = each(match, pairs, options.threads)
    one = np.concatenate([nodes.start[i] + m[0] for (i, _), m in zip(pairs, matched, strict=True)] or [_NONE])
    two = np.concatenate([nodes.start[j] + m[1] for (_, j), m in zip(pairs, matched, strict=True)] or [_NONE])
    distance = np.concatenate([m[2] for m in matched] or [np.zeros(0, np.float32)])
    members, starts = join_tracks(one.astype(np.int64), two.astype(np.int64), distance, nodes.frame)
    return _observed(views, poses, nodes, members, starts, options)


_NONE = np.zeros(0, np.int64)


def _nodes_of(views: Sequence[View]) -> _Nodes:
    counts = [len(view) for view in views]
    return _Nodes(
        start=np.r_[0, np.cumsum(counts)].astype(np.int64),
        frame=np.repeat(np.arange(len(views), dtype=np.int32), counts),
        xy=np.concatenate([view.xy for view in views]),
        seen=np.concatenate([view.seen_xy for view in views]).astype(np.float64),
        points=np.concatenate([view.points for view in views]).astype(np.float64),
        size=np.concatenate([view.size for view in views]),
        row=np.concatenate([view.image_row for view in views]),
    )


def _match(
    one: View, two: View, pose_one: FloatArray, pose_two: FloatArray, radius_px: float, options: MatchingOptions
) -> tuple[IntArray, IntArray, Float32Array]:
    """Keypoints of two views within `radius_px` of each other's projections, both ways, that look alike."""
    two_from_one = invert_pose(pose_two) @ pose_one
    forth = in_front(transform_points(two_from_one, one.points)) * two.focal
    found = match_guided(
        two.descriptors, one.descriptors, two.xy * two.focal, forth, two.classes, one.classes,
        replace(options, guided_radius_px=radius_px), query_signs=two.signs, keyframe_signs=one.signs,
    )  # fmt: skip
    back = in_front(transform_points(invert_pose(two_from_one), two.points[found.query])) * one.focal
    off = np.hypot(*(back - one.xy[found.keyframe] * one.focal).T)
    keep = off < radius_px
    return found.keyframe[keep], found.query[keep], found.distance[keep]


def _observed(
    views: Sequence[View],
    poses: FloatArray,
    nodes: _Nodes,
    members: Int64Array,
    starts: Int64Array,
    options: TrajectoryOptions,
) -> SharedPoints:
    """Tracks as points with their observations, aligned to the sighting in the middle of each."""
    lengths = np.diff(starts)
    track = np.repeat(np.arange(len(lengths)), lengths)
    reference = members[starts[:-1] + lengths // 2] if len(lengths) else _NONE
    order = np.lexsort((nodes.frame[members], track))
    node, track = members[order], track[order]
    xy, found = _align(views, poses, nodes, node, reference[track], options.threads)
    is_reference = node == reference[track]
    aligned = found | is_reference
    focal = np.array([view.focal for view in views])[nodes.frame[node]]
    sigma = pixel_sigma(nodes.size[node], 1.0, options.adjustment.pixel_sigma_px) / focal
    sigma = np.where(aligned, options.adjustment.aligned_sigma_px / focal, sigma)
    there = nodes.frame[reference]
    guess = np.einsum("mij,mj->mi", poses[there][:, :3, :3], nodes.points[reference]) + poses[there][:, :3, 3]
    return SharedPoints(
        points=guess,
        point=track.astype(np.int32),
        image=nodes.frame[node],
        keypoint=(node - nodes.start[nodes.frame[node]]).astype(np.int32),
        xy=xy,
        sigma=sigma,
        aligned=aligned,
        depth=nodes.points[node, 2],
        row=nodes.row[node],
    )


def _align(
    views: Sequence[View], poses: FloatArray, nodes: _Nodes, node: Int64Array, reference: Int64Array, threads: int
) -> tuple[FloatArray, BoolArray]:
    """Where each keyframe shows the patch of the track's reference, and where that was found."""
    xy, found = nodes.xy[node].copy(), np.zeros(len(node), np.bool_)
    key = nodes.frame[reference].astype(np.int64) * len(views) + nodes.frame[node]
    rows = np.flatnonzero(node != reference)
    rows = rows[np.argsort(key[rows], kind="stable")]
    bounds = np.flatnonzero(np.r_[True, np.diff(key[rows]) > 0]) if len(rows) else _NONE
    groups = np.split(rows, bounds[1:]) if len(rows) else []

    def align(here: Int64Array) -> None:  # writes these rows alone
        source, target = nodes.frame[reference[here[0]]], nodes.frame[node[here[0]]]
        one, two = views[source], views[target]
        if one.grey is None or two.grey is None:
            return
        chosen = (reference[here] - nodes.start[source]).astype(np.int32)
        relative = invert_pose(poses[target]) @ poses[source]
        warp, step = patch_warps(two, one, chosen, relative), patch_steps(one, chosen)
        answer, likeness = np.zeros((len(here), 2)), np.empty(len(here))
        align_patches(
            one.grey, two.grey, nodes.seen[reference[here]], warp, step, nodes.seen[node[here]], answer, likeness
        )
        good = likeness > LEAST_LIKENESS
        rays = pixels_to_normalized(two.camera, answer[good])
        usable = np.isfinite(rays).all(axis=1)
        xy[here[good][usable]], found[here[good][usable]] = rays[usable], True

    each(align, groups, threads)
    return xy, found
