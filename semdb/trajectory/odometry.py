"""Frame by frame along a recording: each is placed by keyframes before it, and some become keyframes themselves."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from semdb.geometry import pose_distances, transform_points
from semdb.geometry.volumes import Volume, common_views
from semdb.localization.views import KeyframeView
from semdb.perception.protocols import Encoder
from semdb.trajectory.depth_views import depth_agreement
from semdb.trajectory.edges import Edge, EdgeKind
from semdb.trajectory.frames import EmptyFrame, SeenFrame
from semdb.trajectory.keyframes import Keyframe, Keyframes, sample_of, with_points_only
from semdb.trajectory.laying import lay
from semdb.trajectory.motion import Motion, turn_rates
from semdb.trajectory.observations import FrameObservations, observations_of
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.tracking import (
    Placed,
    agrees,
    found_anywhere,
    holds,
    moved_too_far,
    place_among,
    place_by_motion,
)
from semdb.types import FloatArray

COMPARED = 6  # keyframes near a frame whose common view with it is looked at
REMEMBERED = 15  # frames that say how sharp images are
EDGE_PAIRS = 20  # with a keyframe, for an edge to it


class FrameState(StrEnum):
    """What became of a frame."""

    TRACKED = "tracked"
    LAID = "laid"  # on surfaces of keyframes, where keypoints did not place it
    RELOCALIZED = "relocalized"  # lost, and found again among all keyframes
    LOST = "lost"
    LEFT_OUT = "left out"  # it shows too little, or cannot be read


@dataclass(slots=True, eq=False)
class FrameTrack:
    """What is known of one frame: where it is from its `reference` keyframe, by which observations, and how surely."""

    position: int
    time_s: float
    state: FrameState
    reason: str = ""
    reference: int = -1  # number of a keyframe; -1 without a pose
    reference_from_frame: FloatArray = field(default_factory=lambda: np.eye(4))
    covariance: FloatArray | None = None  # [6, 6] of a right perturbation of it
    observations: FrameObservations | None = None
    keyframe: int = -1  # its number where it is one itself


class Odometry:
    """Takes frames in their order; what it has found lies in `keyframes`, `edges`, `tracks` and `steps`."""

    def __init__(self, encoder: Encoder, options: TrajectoryOptions) -> None:
        self.options = options
        self.encoder = encoder
        self.keyframes = Keyframes()
        self.edges: list[Edge] = []
        self.tracks: list[FrameTrack] = []
        self.steps: list[FloatArray] = []  # [6, 6] of each keyframe against those before it
        self.odometry_poses: list[FloatArray] = []  # [4, 4] of each keyframe as it was found
        self._motion = Motion(options.tracking.motion_gap_s)
        self._sharpness: deque[float] = deque(maxlen=REMEMBERED)
        self._piece = -1
        self._lost = 0
        self._since_keyframe = 0

    def add(self, frame: SeenFrame | EmptyFrame, time_s: float) -> FrameTrack:
        """Places the next frame, or says why not."""
        if isinstance(frame, EmptyFrame):
            track = FrameTrack(frame.position, time_s, FrameState.LEFT_OUT, frame.reason)
            self.tracks.append(track)
            return track
        track = self._place(frame)
        self.tracks.append(track)
        self._sharpness.append(frame.sharpness)
        return track

    def _place(self, frame: SeenFrame) -> FrameTrack:
        placed = self._by_tracking(frame)
        state = FrameState.TRACKED
        if placed is None:
            placed, state = self._by_surfaces(frame), FrameState.LAID
        elif placed.estimate.inliers < self.options.tracking.few_inliers:
            placed = self._laid_from(frame, [placed.pose], self._piece) or placed
        if placed is None:
            placed, state = self.relocalize(frame), FrameState.RELOCALIZED
        if placed is None:
            return self._lose(frame)
        if state is FrameState.RELOCALIZED:
            self._motion.forget()
            self._piece = self.keyframes.all[placed.keyframes[0].keyframe_id].piece
        self._lost = 0
        self._motion.seen(frame.time_s, placed.pose)
        track = track_of(frame, placed, state)
        self._since_keyframe += 1
        if self._is_keyframe(frame, placed):
            self._add_keyframe(frame, placed, track)
        return track

    @property
    def sights(self) -> dict[tuple[int, int], FrameObservations]:
        """What keyframes saw of those that placed them, by the numbers of both."""
        seen = {t.keyframe: t.observations for t in self.tracks if t.keyframe >= 0 and t.observations is not None}
        return {(e.first, e.second): seen[e.second] for e in self.edges if e.second in seen}

    def frame_rates(self, poses: FloatArray) -> FloatArray:
        """How the camera turns in each frame ``[f, 3]``, rad/s in its own frame, with keyframes at `poses`."""
        placed = [track for track in self.tracks if track.reference >= 0]
        rates = np.zeros((1 + max((track.position for track in self.tracks), default=-1), 3))
        if placed:
            rotations = np.stack([poses[t.reference][:3, :3] @ t.reference_from_frame[:3, :3] for t in placed])
            worlds = np.array([self.keyframes.all[t.reference].piece for t in placed])
            times = np.array([track.time_s for track in placed])
            rates[[t.position for t in placed]] = turn_rates(rotations, times, worlds)
        return rates

    def rates(self, poses: FloatArray) -> FloatArray:
        """The same in each keyframe ``[n, 3]``."""
        rates = self.frame_rates(poses)
        return rates[[keyframe.position for keyframe in self.keyframes.all]]

    def _by_tracking(self, frame: SeenFrame) -> Placed | None:
        last = self._motion.last
        if last is None or self._lost > self.options.tracking.patience:
            return None
        predicted = self._motion.predict(frame.time_s)
        views = self._local(last, last if predicted is None else predicted)
        if predicted is not None and self._motion.steady:
            placed = place_by_motion(frame.view, views, predicted, self.options)
            if self._holds(frame, placed):
                return placed
        placed = place_among(frame.view, views, self.options)
        if placed is None or not self._holds(frame, placed):
            return None
        if moved_too_far(placed.pose, last, self._motion.gap_s(frame.time_s), self.options):
            return found_anywhere(frame.view, views, self.options)
        return placed

    def _by_surfaces(self, frame: SeenFrame) -> Placed | None:
        """Lays a frame on surfaces from where the camera was, and from where it should be by now."""
        last = self._motion.last
        if last is None or self._lost > self.options.tracking.patience:
            return None
        predicted = self._motion.predict(frame.time_s, self.options.tracking.surfaces_gap_s)
        starts = [last] if predicted is None else [predicted, last]
        placed = self._laid_from(frame, starts, self._piece)
        if placed is None or moved_too_far(placed.pose, last, self._motion.gap_s(frame.time_s), self.options):
            return None
        return placed

    def _laid_from(self, frame: SeenFrame, starts: list[FloatArray], piece: int) -> Placed | None:
        near = self.keyframes.nearest(starts[0], self.keyframes.in_piece(piece), self.options.tracking.surfaces)
        return lay(frame, self.keyframes, near, starts, self.options)

    def lay_beside(self, frame: SeenFrame, row: int) -> Placed | None:
        """Lays a lost frame, that of the track `row`, on surfaces from where the frames before and after it are."""
        for step in (-1, 1):
            other = row + step
            while 0 <= other < len(self.tracks) and self.tracks[other].reference < 0:
                other += step
            if not 0 <= other < len(self.tracks) or abs(other - row) > self.options.tracking.patience:
                continue
            track = self.tracks[other]
            start = self.keyframes.poses[track.reference] @ track.reference_from_frame
            placed = self._laid_from(frame, [start], self.keyframes.all[track.reference].piece)
            if placed is not None:
                return placed
        return None

    def _holds(self, frame: SeenFrame, placed: Placed | None) -> bool:
        return holds(placed, None if placed is None else self._agreement(frame, placed), self.options)

    def _agreement(self, frame: SeenFrame, placed: Placed) -> float | None:
        """How well the depth of a placed frame fits that of its best keyframe."""
        best = placed.best
        there = self.keyframes.all[best.keyframe_id].depth
        return depth_agreement(there, frame.depth, best.camera_from_world @ placed.pose)

    def _local(self, last: FloatArray, predicted: FloatArray) -> list[KeyframeView]:
        """Keyframes near to where the camera should be, and one near to where it was."""
        numbers, count = self.keyframes.in_piece(self._piece), self.options.tracking.local
        chosen = self.keyframes.nearest(predicted, numbers, count)
        was = self.keyframes.nearest(last, numbers, 1)
        if was and was[0] not in chosen:
            chosen = [*chosen[: count - 1], was[0]]
        return [self.keyframes.view_of(n) for n in chosen]

    def relocalize(self, frame: SeenFrame) -> Placed | None:
        """Looks for a frame among all keyframes of all pieces; only what is as good as certain counts."""
        if not len(self.keyframes):
            return None
        count = self.options.tracking.relocalize
        everywhere = np.ones(len(self.keyframes), np.bool_)
        chosen = self.keyframes.alike(self.encoder.encode(frame.image), everywhere, count)
        last = self._motion.last
        if last is not None:
            near = self.keyframes.nearest(last, self.keyframes.in_piece(self._piece), count // 2)
            chosen = list(dict.fromkeys([*near, *chosen]))
        for number in chosen:
            views = [self.keyframes.view_of(n) for n in self._about(number)]
            placed = found_anywhere(frame.view, views, self.options)
            if placed is not None and self._fits(frame, placed):
                return placed
        return None

    def _fits(self, frame: SeenFrame, placed: Placed) -> bool:
        return agrees(self._agreement(frame, placed), placed.estimate.inliers, self.options)

    def _about(self, number: int) -> list[int]:
        """A keyframe and its neighbours in the same piece."""
        piece = self.keyframes.all[number].piece
        return [
            n
            for n in (number, number - 1, number + 1)
            if 0 <= n < len(self.keyframes) and self.keyframes.all[n].piece == piece
        ]

    def _lose(self, frame: SeenFrame) -> FrameTrack:
        self._lost += 1
        begins = self._piece < 0 or self._lost > self.options.tracking.patience
        if begins and frame.with_depth >= self.options.keyframes.least_points:
            return self._begin_piece(frame)
        reason = "too little of it is seen by keyframes"
        if not len(self.keyframes):
            reason = "too few keypoints have depth for a first keyframe"
        if frame.with_depth < self.options.keyframes.least_points:
            reason += f"; {frame.with_depth} keypoints have depth"
        return FrameTrack(frame.position, frame.time_s, FrameState.LOST, reason)

    def _begin_piece(self, frame: SeenFrame) -> FrameTrack:
        self._piece = 1 + max((keyframe.piece for keyframe in self.keyframes.all), default=-1)
        self._lost = 0
        self._motion.forget()
        self._motion.seen(frame.time_s, np.eye(4))
        track = FrameTrack(frame.position, frame.time_s, FrameState.TRACKED)
        self._add_keyframe(frame, None, track)
        return track

    def _is_keyframe(self, frame: SeenFrame, placed: Placed) -> bool:
        options = self.options.keyframes
        if frame.with_depth < options.least_points and not placed.laid:
            return False
        sample = transform_points(placed.pose, sample_of(frame.view))
        volume = Volume(frame.view.camera, placed.pose, sample)
        near = self.keyframes.nearest(placed.pose, self.keyframes.in_piece(self._piece), COMPARED)
        common = max(common_views(volume, [self.keyframes.volume(n) for n in near]), default=0.0)
        if common < options.urgent_view or placed.estimate.inliers < options.urgent_inliers:
            return True
        few = placed.laid or placed.estimate.inliers < self.options.tracking.many_inliers
        if few and near and float(pose_distances(placed.pose, self.keyframes.poses[near[0]][None])[0]) > options.far:
            return True
        if common >= options.common_view:
            return False
        usual = float(np.median(self._sharpness)) if self._sharpness else 0.0
        return frame.sharpness >= options.sharp * usual

    def _add_keyframe(self, frame: SeenFrame, placed: Placed | None, track: FrameTrack) -> None:
        number = len(self.keyframes)
        pose = np.eye(4) if placed is None else placed.pose
        view = with_points_only(frame.view)
        vector = self.encoder.encode(frame.image)
        sample, surface = sample_of(view), frame.surface_view()
        at = number, frame.position, frame.time_s, self._piece
        self.keyframes.add(Keyframe(*at, view, vector, sample, frame.depth, surface), pose)
        self.odometry_poses.append(pose)
        self._since_keyframe = 0
        if placed is not None:
            edges, step = edges_to(number, placed)
            self.edges += edges
            self.steps.append(step)
        else:
            self.steps.append(np.zeros((6, 6)))
        track.keyframe = track.reference = number
        track.reference_from_frame, track.covariance = np.eye(4), np.zeros((6, 6))


def track_of(frame: SeenFrame, placed: Placed, state: FrameState) -> FrameTrack:
    """What is kept of a placed frame: it hangs on the keyframe that it has most pairs with."""
    reference = placed.best
    return FrameTrack(
        position=frame.position,
        time_s=frame.time_s,
        state=state,
        reference=reference.keyframe_id,
        reference_from_frame=reference.camera_from_world @ placed.pose,
        covariance=local_covariance(placed),
        observations=None if placed.laid else observations_of(frame.view, placed),
    )


def local_covariance(placed: Placed) -> FloatArray:
    """Covariance ``[6, 6]`` of a placed frame's pose as a right perturbation, in its own frame."""
    covariance = placed.estimate.covariance
    if covariance is None:
        return np.diag([0.05**2] * 3 + [0.03**2] * 3)
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = placed.pose[:3, :3].T
    local: FloatArray = turn @ covariance @ turn.T
    return local


def edges_to(number: int, placed: Placed) -> tuple[list[Edge], FloatArray]:
    """Edges of a new keyframe to those that placed it, and the covariance ``[6, 6]`` of the step.

    One pose made all edges: each is so much less sure that together they say what it says.
    """
    covariance = local_covariance(placed)
    pairs = placed.estimate.per_keyframe
    order = sorted(range(len(pairs)), key=lambda slot: -pairs[slot])
    chosen = [slot for slot in order if pairs[slot] >= (1 if placed.laid else EDGE_PAIRS)][:2] or order[:1]
    information = np.asarray(np.linalg.inv(covariance * len(chosen)), np.float64)
    edges = []
    for slot in chosen:
        keyframe = placed.keyframes[slot]
        relative = keyframe.camera_from_world @ placed.pose
        edges.append(Edge(keyframe.keyframe_id, number, EdgeKind.ODOMETRY, relative, information, pairs[slot]))
    return edges, covariance
