"""Frame after frame in a map: predicted, placed near the prediction, weighed against it; or looked for when lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp, so3_log, transform_points
from semdb.localization.confidence import sigmas
from semdb.localization.views import KeyframeView, View, in_kind_of
from semdb.tracking.options import MotionOptions, TrackerOptions
from semdb.tracking.placing import (
    Placed,
    convinces,
    place_anywhere_near,
    place_near,
    search_radius_px,
)
from semdb.tracking.pose_filter import FilterState, Step, begin, faded, measured, moved, surprise, transition_of
from semdb.tracking.smoothing import Passage
from semdb.tracking.states import TrackedPose, TrackSource, TrackState
from semdb.tracking.steps import FrameBefore, SeenStep, frame_before, is_steady, refined_step, step_between
from semdb.types import FloatArray, Localization, Verdict

USUAL_DISTANCE_M = 2.0  # of what is seen, where nothing is known of it
SHORTEST_S = 1e-4
BENT_EVERY = 5  # frames
LEAST_ROUGH = 0.25  # of the unrest, for steps that are not exact


class MapKeyframes(Protocol):
    """Keyframes of a map by where they are."""

    def near(
        self, pose: FloatArray, limit: float, without: Collection[int], count: int | None = None
    ) -> tuple[list[int], FloatArray]: ...

    def views(
        self, keyframe_ids: Sequence[int], descriptors: npt.NDArray[np.generic] | None = None
    ) -> list[KeyframeView]: ...


Relocalize = Callable[[], Localization]


@dataclass(frozen=True, slots=True, eq=False)
class _Fix:
    """A pose found in the whole map that waits for a second one which agrees."""

    state: FilterState
    time_s: float
    confidence: float


class Tracker:
    """One camera in one map. Frames are given in the order of their times; it is not for several threads at once."""

    def __init__(self, keyframes: MapKeyframes, options: TrackerOptions | None = None) -> None:
        self.options = options or TrackerOptions()
        self.keyframes = keyframes
        self._state: FilterState | None = None
        self._velocity: FloatArray | None = None  # [6] in the camera's frame, per second, when it was last seen
        self._unseen_s = 0.0  # since then
        self._time_s = -np.inf  # of the last frame
        self._seen_s = -np.inf  # of the last one that was placed in the map
        self._before: FrameBefore | None = None  # the last frame with points
        self._steady = True  # it goes on as it went, as far as the last two images show
        self._odometry: FloatArray | None = None  # at the last frame
        self._waiting: list[_Fix] = []
        self._map_from_odom: FloatArray | None = None
        self._begun = False  # the last relocalization began anew
        self._expected: FilterState | None = None  # where the motion put the last frame, before it was placed
        self.passage = Passage(None, None, None)  # of the last frame, for a smoother
        self._recorded: FloatArray | None = None  # [6, 6] how far recorded poses are off their images hereabouts
        self._since_bent = -1  # frames since that was looked at
        self._unrest = self.options.motion.first_unrest  # how much worse steps are than their noise says, squared

    def update(
        self, view: View, time_s: float, relocalize: Relocalize, odom_from_camera: FloatArray | None = None
    ) -> TrackedPose:
        """The pose of the next frame. `relocalize` finds it in the whole map; it is asked only where tracking fails.

        `odom_from_camera` ``[4, 4]`` is where the robot's own odometry has the camera at that time. Raises ValueError
        for a time that is not after the last one, and what `relocalize` raises.
        """
        started = time.perf_counter()
        gap_s = time_s - self._time_s
        if not gap_s > SHORTEST_S:
            raise ValueError(f"frames come in the order of their times: {time_s} s is not after {self._time_s} s")
        step, source, seen = self._motion(view, gap_s, odom_from_camera)
        before, found = self._state, None
        self._expect(before, step)
        placed = self._by_keyframes(view)
        if placed is not None:
            exact = None if seen is None else self._exactly(view, seen, placed)
            if exact is not None:
                self._expect(before, exact)
            found = self._accept(view, placed, time_s)
            if found is not None:
                step = exact or step
            elif exact is not None:  # it is solved with how the image turned in a pose that does not hold
                self._expect(before, step)
        self._waiting = [
            replace(fix, state=moved(fix.state, step, self.options.motion)) for fix in self._waiting if step is not None
        ]
        if found is None:
            found = self._relocalized(view, time_s, relocalize) or self._carried_on(time_s, source)
        begun = found.source is TrackSource.RELOCALISED and self._begun
        transition = None if before is None or step is None else transition_of(before, step, self.options.motion)
        self.passage = Passage(None if begun else self._expected, transition, self._state)
        self._remember(view, placed, found, step, source, gap_s, time_s, odom_from_camera)
        found = self._with_odometry(found, odom_from_camera)
        return replace(found, latency_ms=(time.perf_counter() - started) * 1000)

    def _expect(self, before: FilterState | None, step: Step | None) -> None:
        """The state that a step from `before` leads to."""
        self._expected = None if before is None or step is None else moved(before, step, self.options.motion)
        self._state = self._expected or before

    def _motion(
        self, view: View, gap_s: float, odom_from_camera: FloatArray | None
    ) -> tuple[Step | None, TrackSource, SeenStep | None]:
        """How the camera went since the last frame: by its odometry or as it went, and by what both images show."""
        if self._state is None and not self._waiting:
            return None, TrackSource.NONE, None
        options, source = self.options.motion, TrackSource.PREDICTED
        if odom_from_camera is not None and self._odometry is not None:
            step, source = odometry_step(self._odometry, odom_from_camera, options), TrackSource.ODOMETRY
        else:
            step = predicted_step(self._velocity, gap_s, self._unseen_s, options)
        if self._before is not None and self.options.step:
            expected = step.before_from_after
            before, placing = self._before.keyframe, self.options.placing
            seen = step_between(before, view, expected, placing, steady=self._steady)
            if seen is not None:
                found = seen.step
                self._steady = is_steady(view, expected, found.before_from_after)
                noise = seen_noise(found, options, max(self._unrest, LEAST_ROUGH)) + self._bending()
                return Step(found.before_from_after, noise), TrackSource.ODOMETRY, seen
        return step, source, None

    def _bending(self) -> FloatArray:
        """How much otherwise than the camera ``[6, 6]`` a pose in the map moves here, its recorded poses being off."""
        if self._recorded is None:
            return np.zeros((6, 6))
        own = np.diag(self._recorded)
        bent: FloatArray = self.options.motion.recorded * np.diag(np.repeat([own[:3].mean(), own[3:].mean()], 3))
        return bent

    def _exactly(self, view: View, seen: SeenStep, placed: Placed) -> Step | None:
        """A step between two images again, now that it is known how they turned while they were read out.

        None where that is not known of one of them, or says nothing that is not known better by the map.
        """
        motion = self.options.motion
        if self._before is None or self._before.turn is None or placed.estimate.turn is None:
            return None
        turned = float(np.linalg.norm(self._before.turn) + np.linalg.norm(placed.estimate.turn))
        bent = self._bending()
        if bent[0, 0] + self._unrest * (motion.exact_m_per_rad * turned) ** 2 > motion.bent_m**2:
            return None
        found = refined_step(self._before, view, seen, placed.estimate.turn)
        if found is None:
            return None
        return Step(found.before_from_after, exact_noise(found, turned, motion, self._unrest) + bent)

    def _by_keyframes(self, view: View) -> Placed | None:
        """A pose by the keyframes near to where the camera should be."""
        if self._state is None:
            return None
        placing, pose = self.options.placing, self._state.pose
        ids, _ = self.keyframes.near(pose, placing.farthest, (), placing.keyframes)
        keyframes = self.keyframes.views(ids, view.descriptors)
        if not keyframes:
            return None
        view, distance = in_kind_of(keyframes, view), _distance_of(keyframes[0], pose)
        radius = search_radius_px(view, self._state.pose_covariance, distance, placing)
        # how bent the map is shows slowly and costs time: it is looked at now and then
        self._since_bent = (self._since_bent + 1) % BENT_EVERY
        near = replace(placing, pose=replace(placing.pose, evident=self._since_bent == 0))
        placed = place_near(view, keyframes, pose, radius, near) or place_anywhere_near(view, keyframes, placing)
        if placed is not None and placed.estimate.recorded is not None:
            self._recorded = placed.estimate.recorded
        return placed

    def _accept(self, view: View, placed: Placed, time_s: float) -> TrackedPose | None:
        """The frame with a pose near keyframes, unless it contradicts the motion."""
        state = self._state
        if state is None:
            return None
        covariance = placed.covariance
        off = surprise(state, placed.pose, covariance) / self.options.gate
        if off > 1:
            metres, degrees = pose_error(placed.pose, state.pose)
            if (
                metres > self.options.jump_m
                or degrees > self.options.jump_deg
                or not convinces(view, placed, self.options.placing)
            ):
                return None
            state = self._expected = faded(state, off)
        self._learn(off)
        self._state = measured(state, placed.pose, covariance, self.options.motion)
        self._seen_s, self._waiting = time_s, []
        reason = f"{placed.estimate.inliers} keypoints agree with {len(placed.keyframes)} keyframes"
        return self._tracked(TrackState.TRACKING, TrackSource.TRACKED, placed.estimate.inliers, reason, placed.pose)

    def _learn(self, off: float) -> None:
        """Takes into account how far a pose was off, in units of the gate, for the noise of steps to come."""
        motion = self.options.motion
        seen = np.clip(self._unrest * off * self.options.gate / 6, 0.0, motion.most_unrest)  # six is expected
        self._unrest = float(
            np.clip(self._unrest + (seen - self._unrest) / motion.memory, motion.least_unrest, motion.most_unrest)
        )

    def _relocalized(self, view: View, time_s: float, relocalize: Relocalize) -> TrackedPose | None:
        """The frame as found in the whole map: at once where the motion agrees, else when a second one agrees."""
        if len(view) < self.options.placing.least_inliers:
            return None  # it shows nothing that could be found
        answer = relocalize()
        if answer.verdict is not Verdict.LOCALIZED or answer.world_from_camera is None or answer.covariance is None:
            return None
        pose, covariance, motion = answer.world_from_camera, answer.covariance, self.options.motion
        first = self._state is None and not self._waiting and answer.confidence >= self.options.sure
        self._begun = True
        reason = f"found in the whole map: {answer.reason}"
        for state in [self._state, *(fix.state for fix in reversed(self._waiting))]:
            agreed = None if state is None else self._agreed(state, pose, covariance)
            if state is not None and agreed is not None:
                self._begun = state is not self._state
                self._state = measured(state, pose, agreed, motion)
                break
        else:
            fix = _Fix(begin(pose, covariance, motion), time_s, answer.confidence)
            if not first:
                return self._wait(fix, answer, reason)
            self._state = fix.state
        if self._begun:
            self._velocity = None
        self._waiting, self._seen_s = [], time_s
        return self._tracked(
            TrackState.TRACKING, TrackSource.RELOCALISED, answer.inliers, reason, pose, answer.confidence
        )

    def _agreed(self, state: FilterState, pose: FloatArray, covariance: FloatArray) -> FloatArray | None:
        """The covariance with which a pose joins a state that it agrees with, None where it contradicts it."""
        off = surprise(state, pose, covariance) / self.options.gate
        if off <= 1:
            return covariance
        metres, degrees = pose_error(pose, state.pose)
        near = metres <= self.options.agree_m and degrees <= self.options.agree_deg
        return covariance * off if near else None

    def _wait(self, fix: _Fix, answer: Localization, reason: str) -> TrackedPose | None:
        """An answer that nothing confirms yet: shown as such where there is no other pose."""
        elsewhere = self._state is not None or bool(self._waiting)
        self._waiting = [*self._waiting[-2:], fix]
        if self._state is not None:
            return None
        doubt = "it contradicts an earlier one; a third decides" if elsewhere else "a second one must agree"
        return TrackedPose(
            TrackState.INITIALISING, TrackSource.RELOCALISED, answer.world_from_camera, answer.covariance,
            answer.inliers, f"{reason}; {doubt}", 0.0, answer.confidence, answer.world_from_camera,
        )  # fmt: skip

    def _carried_on(self, time_s: float, source: TrackSource) -> TrackedPose:
        """Motion alone, until it says too little."""
        options, state = self.options, self._state
        if state is None:
            return _lost("no keyframe of the map is recognised")
        unseen_s = time_s - self._seen_s
        metres, degrees = sigmas(state.pose_covariance)
        if unseen_s > options.coast_s or metres > options.coast_m or degrees > options.coast_deg:
            self._state, self._velocity = None, None
            return _lost(f"no keyframe of the map was recognised for {unseen_s:.1f} s")
        reason = f"no keyframe of the map is recognised; carried on for {unseen_s:.1f} s"
        return self._tracked(TrackState.COASTING, source, 0, reason, None)

    def _tracked(
        self,
        state: TrackState,
        source: TrackSource,
        inliers: int,
        reason: str,
        own: FloatArray | None,
        confidence: float | None = None,
    ) -> TrackedPose:
        now = self._state
        if now is None:
            raise AssertionError("a pose without a state")
        return TrackedPose(state, source, now.pose, now.pose_covariance, inliers, reason, 0.0, confidence, own)

    def _remember(
        self,
        view: View,
        placed: Placed | None,
        found: TrackedPose,
        step: Step | None,
        moved_by: TrackSource,
        gap_s: float,
        time_s: float,
        odom_from_camera: FloatArray | None,
    ) -> None:
        self._time_s, self._odometry = time_s, odom_from_camera
        if self._state is None:
            self._velocity = None
        elif step is not None and moved_by is not TrackSource.PREDICTED:
            motion = step.before_from_after
            self._velocity = np.concatenate([motion[:3, 3], so3_log(motion[:3, :3])]) / gap_s
        seen = found.state is TrackState.TRACKING or moved_by is TrackSource.ODOMETRY
        self._unseen_s = 0.0 if seen else self._unseen_s + gap_s
        self._before = frame_before(view, placed if found.source is TrackSource.TRACKED else None)

    def _with_odometry(self, found: TrackedPose, odom_from_camera: FloatArray | None) -> TrackedPose:
        """The same with what corrects the odometry; it stays as it was while nothing is measured."""
        if odom_from_camera is None:
            return found
        if found.state is TrackState.TRACKING and found.world_from_camera is not None:
            self._map_from_odom = found.world_from_camera @ invert_pose(odom_from_camera)
        return replace(found, map_from_odom=self._map_from_odom)


def predicted_step(velocity: FloatArray | None, gap_s: float, unseen_s: float, options: MotionOptions) -> Step:
    """The camera goes on with `velocity` ``[6]`` per second in its own frame, or from rest where it is not known.

    `unseen_s` is for how long its motion was not seen before: what is carried on slows down, and errors grow with time.
    """
    speed = np.zeros(6) if velocity is None else velocity
    # the way of a speed that decays exponentially
    moved_by = speed * options.slows_s * (np.exp(-unseen_s / options.slows_s) * -np.expm1(-gap_s / options.slows_s))
    spread = np.array([options.acceleration] * 3 + [options.turn_acceleration] * 3) * gap_s**2
    astray = np.array([options.astray_m_s] * 3 + [options.astray_rad_s] * 3)
    grown = astray**2 * (
        (unseen_s + gap_s) ** 2 - unseen_s**2
    )  # so that it is `astray` times the whole time in the end
    if velocity is None:
        spread = spread + np.array([0.5] * 3 + [1.0] * 3) * gap_s  # it may move, at so much a second
    variance = np.maximum(grown, spread**2 if unseen_s == 0 else 0.0)
    return Step(pose_from(so3_exp(moved_by[3:]), moved_by[:3]), np.diag(variance))


def odometry_step(before: FloatArray, now: FloatArray, options: MotionOptions) -> Step:
    """The step between two poses ``[4, 4]`` of a robot's odometry."""
    motion = invert_pose(before) @ now
    metres = options.odometry_m + options.odometry_share * float(np.linalg.norm(motion[:3, 3]))
    turn = options.odometry_rad + options.odometry_share * float(np.linalg.norm(so3_log(motion[:3, :3])))
    return Step(motion, np.diag([metres**2] * 3 + [turn**2] * 3))


def seen_noise(step: Step, options: MotionOptions, unrest: float = 1.0) -> FloatArray:
    """How uncertain a step between two images is ``[6, 6]``."""
    way = float(np.linalg.norm(step.before_from_after[:3, 3]))
    turn = float(np.linalg.norm(so3_log(step.before_from_after[:3, :3])))
    metres = options.step_m + options.step_way_share * way + options.step_m_per_rad * turn
    radians = options.step_rad + options.step_turn_share * turn
    found: FloatArray = step.covariance * options.step_factor**2 + unrest * np.diag([metres**2] * 3 + [radians**2] * 3)
    return found


def exact_noise(step: Step, turned: float, options: MotionOptions, unrest: float) -> FloatArray:
    """The same of one that knows how the images turned while they were read out, `turned` (rad) together."""
    metres = options.exact_m + options.exact_m_per_rad * turned
    metres += options.exact_way_share * float(np.linalg.norm(step.before_from_after[:3, 3]))
    radians = options.exact_rad + options.exact_rad_per_rad * turned
    found: FloatArray = step.covariance * options.exact_factor**2 + unrest * np.diag([metres**2] * 3 + [radians**2] * 3)
    return found


def _lost(reason: str) -> TrackedPose:
    return TrackedPose(TrackState.LOST, TrackSource.NONE, None, None, 0, reason, 0.0)


def _distance_of(keyframe: KeyframeView, pose: FloatArray) -> float:
    """How far what a keyframe shows is from a camera, metres (its nearest quarter)."""
    z = transform_points(invert_pose(pose), keyframe.world_points)[:, 2]
    z = z[z > 0.1]
    return float(np.quantile(z, 0.25)) if len(z) else USUAL_DISTANCE_M
