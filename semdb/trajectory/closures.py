"""Loop closures: keyframes that may show the same place, looked at both ways before they count."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from semdb.geometry import invert_pose, pose_distances, pose_error
from semdb.geometry.volumes import common_view, common_views
from semdb.localization.confidence import sigmas
from semdb.localization.views import KeyframeView
from semdb.trajectory.depth_views import depth_agreement
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.measuring import joined
from semdb.trajectory.observations import FrameObservations, observations_of
from semdb.trajectory.odometry import local_covariance
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.tracking import Placed, agrees, found_anywhere
from semdb.types import BoolArray, FloatArray

BESIDE = 2  # keyframes so near to a candidate are not candidates too

Progress = Callable[[int, int], None]


class ClosureSearch:
    """Looks for closures between keyframes; a pair is looked at once."""

    def __init__(self, keyframes: Keyframes, options: TrajectoryOptions) -> None:
        self.keyframes = keyframes
        self.options = options
        self.found: dict[tuple[int, int], Edge | None] = {}  # None: nothing in common
        self.sights: dict[tuple[int, int], FrameObservations] = {}  # of what was verified, both ways

    @property
    def edges(self) -> list[Edge]:
        return [edge for _, edge in sorted(self.found.items()) if edge is not None]

    def look(self, pairs: Sequence[tuple[int, int]], progress: Progress | None = None) -> None:
        """Verifies those of `pairs` that were not verified yet."""
        new = [pair for pair in dict.fromkeys(pairs) if pair not in self.found]
        for done, (first, second) in enumerate(new, start=1):
            self.found[first, second] = self.verify(first, second)
            if progress is not None:
                progress(done, len(new))

    def apart(self, number: int) -> BoolArray:
        """Which keyframes ``[n]`` are long enough before or after one to close a loop with it."""
        own, options = self.keyframes.all[number], self.options.closures
        return np.array(
            [
                abs(other.time_s - own.time_s) >= options.apart_s
                or abs(other.number - number) >= options.apart_keyframes
                or other.piece != own.piece
                for other in self.keyframes.all
            ],
            np.bool_,
        )

    def alike(self) -> list[tuple[int, int]]:
        """Pairs of keyframes that look alike by their place vectors."""
        pairs = []
        for keyframe in self.keyframes.all:
            order = self.keyframes.alike(keyframe.vector, self.apart(keyframe.number), len(self.keyframes))
            pairs += [_pair(keyframe.number, n) for n in _spread(order, self.options.closures.alike)]
        return sorted(set(pairs))

    def near(self, component: Sequence[int]) -> list[tuple[int, int]]:
        """Pairs of keyframes that should see the same by their poses; `component` ``[n]`` tells which share a world."""
        options, pairs = self.options.closures, []
        volumes = [self.keyframes.volume(n) for n in range(len(self.keyframes))]
        if not volumes:
            return []
        centres = np.stack([volume.centre for volume in volumes])
        worlds = np.asarray(component)
        for number, volume in enumerate(volumes):
            possible = np.flatnonzero(self.apart(number) & (worlds == worlds[number]))
            distance = np.linalg.norm(centres[possible] - centres[number], axis=1)
            candidates = possible[np.argsort(distance, kind="stable")[: options.candidates]].tolist()
            shares = common_views(volume, [volumes[other] for other in candidates]).tolist()
            ranked = [(-s, n) for s, n in zip(shares, candidates, strict=True) if s >= options.near_view]
            pairs += [_pair(number, other) for other in _spread([n for _, n in sorted(ranked)], options.near)]
        return sorted(set(pairs))

    def side_by_side(self, one: Sequence[int], two: Sequence[int]) -> tuple[list[tuple[int, int]], float]:
        """Pairs of keyframes of two sets that should look the same, and how many at least should be verified.

        Each of `two` with the nearest of `one` that has half of its view in common, evenly spread. From about the same
        place nearly all are verified, from farther away a few.
        """
        options = self.options.closures
        poses = np.stack([self.keyframes.poses[number] for number in one])
        found, distances = [], []
        for number in two:
            distance = pose_distances(self.keyframes.poses[number], poses)
            nearest = int(np.argmin(distance))
            other = one[nearest]
            if distance[nearest] > options.side_farthest:
                continue
            if common_view(self.keyframes.volume(number), self.keyframes.volume(other)) >= options.side_view:
                found.append(_pair(number, other))
                distances.append(distance[nearest])
        spread = np.unique(np.linspace(0, len(found) - 1, min(len(found), options.side_pairs)).round().astype(int))
        near = np.array([distances[n] <= options.side_near for n in spread], np.bool_)
        expected = np.where(near, options.side_share_near, options.side_share_far).sum()
        return [found[n] for n in spread], float(expected)

    def verified(self, pair: tuple[int, int]) -> bool:
        """Whether a pair that was looked at shows the same place."""
        edge = self.found.get(pair)
        return edge is not None and edge.state is not EdgeState.FAILED

    def verify(self, first: int, second: int) -> Edge | None:
        """The edge between two keyframes if their images show the same place, both ways; None where nothing agrees."""
        confidence = self.options.closures.session_confidence if self._kind(first, second) is EdgeKind.SESSION else 0.0
        forth = self._one_way(first, second, confidence)
        if forth is None:
            return None
        back = self._one_way(second, first, None)
        there = forth.best.camera_from_world @ forth.pose
        one, two = self.keyframes.all[first], self.keyframes.all[second]
        agreement = depth_agreement(one.depth, two.depth, there)
        reason = ""
        if back is None:
            reason = "seen from the second keyframe only"
        elif not agrees(agreement, forth.estimate.inliers, self.options):
            reason = f"depth fits {agreement:.0%} only"
        if back is None or reason:
            return self._failed(first, second, there, forth.estimate.inliers, reason)
        edge = self._joined(first, second, forth, back)
        if edge.state is EdgeState.ACCEPTED:
            self.sights[first, second] = observations_of(two.view, forth)
            self.sights[second, first] = observations_of(one.view, back)
        return edge

    def _joined(self, first: int, second: int, forth: Placed, back: Placed) -> Edge:
        """The edge that both ways make, failed where they differ."""
        there = forth.best.camera_from_world @ forth.pose
        returned = invert_pose(back.best.camera_from_world @ back.pose)
        inliers = min(forth.estimate.inliers, back.estimate.inliers)
        middle, spread = joined(there, local_covariance(forth), invert_pose(returned), local_covariance(back))
        metres, degrees = pose_error(there, returned)
        sigma_m, sigma_deg = sigmas(2 * spread)
        options = self.options.closures
        if metres > max(options.agree_m, options.agree_sigmas * sigma_m) or degrees > max(
            options.agree_deg, options.agree_sigmas * sigma_deg
        ):
            reason = f"both ways differ by {metres:.3f} m and {degrees:.1f} deg"
            return self._failed(first, second, there, inliers, reason)
        information = np.asarray(np.linalg.inv(spread), np.float64)
        return Edge(first, second, self._kind(first, second), middle, information, inliers)

    def _one_way(self, anchor: int, query: int, confidence: float | None) -> Placed | None:
        """The keyframe `query` placed by `anchor`, at its own pose."""
        view: KeyframeView = self.keyframes.view_of(anchor)
        return found_anywhere(self.keyframes.all[query].view, [view], self.options, confidence=confidence)

    def _kind(self, first: int, second: int) -> EdgeKind:
        same = self.keyframes.all[first].piece == self.keyframes.all[second].piece
        return EdgeKind.LOOP if same else EdgeKind.SESSION

    def _failed(self, first: int, second: int, relative: FloatArray, inliers: int, reason: str) -> Edge:
        kind = self._kind(first, second)
        return Edge(first, second, kind, relative, np.eye(6), inliers, EdgeState.FAILED, reason)


def _pair(one: int, two: int) -> tuple[int, int]:
    return min(one, two), max(one, two)


def _spread(order: list[int], count: int) -> list[int]:
    """The first `count` of `order` that are not beside one that was taken."""
    chosen: list[int] = []
    for number in order:
        if all(abs(number - taken) > BESIDE for taken in chosen):
            chosen.append(number)
            if len(chosen) == count:
                break
    return chosen
