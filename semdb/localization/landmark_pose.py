"""A pose from things alone: an image's objects matched with the landmarks of a map, where texture fails.

Hypotheses are the keyframes' poses, as they are and looking a little aside, and poses that put pairs of objects where
pairs of landmarks of their names are, at distances that are measured or judged by size, held as keyframes are. Each is
scored by what should be seen from there: boxes that agree, landmarks that are missing, objects that the map does not
have. The best are refined (Levenberg-Marquardt); one is an answer where it agrees well, and nothing elsewhere nearly as
well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, pixels_to_normalized, rotation_angle_deg
from semdb.localization import landmark_kernels as kernels
from semdb.localization.landmark_starts import poses_from_pairs, turned_cameras
from semdb.types import Camera, FloatArray, Int64Array


@dataclass(frozen=True, slots=True)
class LandmarkPoseOptions:
    """Bounds and weights are fitted by `bench.landmarks.coarse` on other rooms and recordings than those it judges."""

    least_score: float = 0.2  # of a detection
    most_detections: int = 24
    most_pairs: int = 400  # of pairs of an object with a landmark
    most_keyframes: int = 400  # whose poses are tried, evenly chosen of a larger map
    most_turned: int = 1200  # keyframes' poses that are turned aside
    ways_to_hold: int = 6  # the camera
    distance_slack: float = 0.35  # by which distances judged by size may be wrong, as a share
    refined: int = 24  # hypotheses
    wide: float = 3.0  # times as much, where hypotheses are compared that are not refined
    # how far an image is from the nearest keyframe: of up and of level axes in the camera (rad), of its place along
    # level axes and in height (m); beyond three of these it costs little more
    widths: tuple[float, float, float, float] = (0.08, 0.25, 0.2, 0.12)
    near_weight: float = 0.5  # of that, where hypotheses are compared
    least_matched: int = 3  # landmarks that agree
    least_lead: float = 2.0  # of the score, over the best pose elsewhere
    elsewhere_m: float = 0.7
    elsewhere_deg: float = 20.0
    least_trust: float = 0.8
    covariance_scale: float = 1.6
    sure: float = 0.9  # mean score of detections for which that holds
    usual_residuals: float = 20.0  # of one standard deviation, that are added to those of an image
    most_sigma_m: float = 0.7
    most_sigma_deg: float = 17.0


@dataclass(frozen=True, slots=True, eq=False)
class MapLandmarks:
    """Confirmed landmarks of a map as they are matched, with the poses of its keyframes."""

    classes: Mapping[str, int]  # names that a detector gives, to columns of `names`
    corners: FloatArray  # [l, 8, 3] of their boxes, a little smaller
    centres: FloatArray  # [l, 3]
    sizes: FloatArray  # [l, 3] of their boxes
    names: FloatArray  # [l, c] logarithm of how much likelier a name is of a landmark than of anything
    seen: FloatArray  # [l] how likely a landmark is found where it lies in the image
    cameras: FloatArray  # [k, 4, 4] camera_from_world of keyframes
    level: FloatArray  # [3, 3] columns: two level axes, and up
    edge: float  # the share of the side of a box by which its edges are off

    @property
    def reach(self) -> FloatArray:
        """Half of the diagonal of each, metres."""
        return np.asarray(np.linalg.norm(self.sizes, axis=1) / 2, np.float64)

    def __len__(self) -> int:
        return len(self.centres)


@dataclass(frozen=True, slots=True, eq=False)
class SeenThings:
    """Detections of an image: boxes at unit distance without the lens, numbers of names, places by depth."""

    boxes: FloatArray  # [d, 4]
    category: Int64Array  # [d]
    scores: FloatArray  # [d]
    points: FloatArray  # [d, 3] in the camera's frame, NaN without depth
    frame: FloatArray  # [4] the image

    def __len__(self) -> int:
        return len(self.boxes)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkPose:
    """The best pose by landmarks, and how it stands to what else is possible."""

    world_from_camera: FloatArray
    covariance: FloatArray  # [6, 6] translation (m), then rotation (rad, left perturbation in the world)
    score: float  # logarithm of how much likelier the boxes are here than anywhere
    lead: float  # over the best pose elsewhere
    matched: int
    expected: int  # landmarks that lie in the image
    sureness: float  # mean score of the detections
    measured: bool  # whether depth has places of things
    sigma_m: float
    sigma_deg: float

    @property
    def trust(self) -> float:
        """The probability that the pose is right rather than of another place, as fitted.

        Detections that are all of one high score, as masks that a recording brings are, overrate how much they say, and
        their distances still more.
        """
        sure = (self.sureness - 0.6) / 0.3
        value = self.score * (2.05 - 0.64 * sure) / 10 + 1.19 * float(np.log1p(max(self.lead, 0.0)))
        value -= (1.32 + 0.93 * self.measured) * sure + 5.41
        return float(1 / (1 + np.exp(-value)))

    def doubt(self, options: LandmarkPoseOptions) -> str:
        """Why it is no answer, in a line; empty where it is one."""
        if self.matched < options.least_matched:
            return f"only {self.matched} landmarks agree"
        if self.lead < options.least_lead:
            return "landmarks agree as well elsewhere"
        if self.trust < options.least_trust:
            return f"landmarks agree too little ({self.matched}, {self.trust:.0%} likely to be right)"
        if self.sigma_m > options.most_sigma_m or self.sigma_deg > options.most_sigma_deg:
            return f"landmarks leave the pose free by {self.sigma_m:.2f} m and {self.sigma_deg:.0f} deg"
        return ""

    def as_mapping(self) -> dict[str, float]:
        """Name to number, for results and files."""
        return {
            "landmarks": float(self.matched),
            "landmarks_expected": float(self.expected),
            "landmark_score": self.score,
            "landmark_lead": self.lead,
            "landmark_trust": self.trust,
        }


def things_of(
    camera: Camera,
    names: Sequence[str],
    boxes: FloatArray,
    scores: FloatArray,
    points: FloatArray,
    landmarks: MapLandmarks,
    options: LandmarkPoseOptions,
) -> SeenThings:
    """Detections as they are matched: `boxes` ``[n, 4]`` in pixels (the last inside), `points` ``[n, 3]``.

    Names that no landmark goes by are left out, and scores below the least.
    """
    known = np.array([landmarks.classes.get(name, -1) for name in names], np.int64)
    keep = np.flatnonzero((known >= 0) & (scores >= options.least_score))
    keep = keep[np.argsort(-scores[keep], kind="stable")][: options.most_detections]
    edges = np.array([[-0.5, -0.5, camera.width - 0.5, camera.height - 0.5]])
    grown = boxes[keep] + np.array([-0.5, -0.5, 0.5, 0.5])
    plane = unit_boxes(camera, np.concatenate([grown, edges]))
    return SeenThings(plane[:-1], known[keep], np.clip(scores[keep], 0.01, 0.98), points[keep], plane[-1])


def unit_boxes(camera: Camera, boxes: FloatArray) -> FloatArray:
    """Boxes in pixels at unit distance: the middles of their sides, without the lens."""
    x1, y1, x2, y2 = boxes.T
    mx, my = (x1 + x2) / 2, (y1 + y2) / 2
    middles = np.stack([np.stack(side, axis=1) for side in ((x1, my), (mx, y1), (x2, my), (mx, y2))], axis=1)
    plane = pixels_to_normalized(camera, middles.reshape(-1, 2)).reshape(-1, 4, 2)
    return np.ascontiguousarray(np.stack([plane[:, k, k % 2] for k in range(4)], axis=1))


def find_pose(things: SeenThings, landmarks: MapLandmarks, options: LandmarkPoseOptions) -> LandmarkPose | None:
    """The best pose of an image that shows `things`; None where there is nothing to go by."""
    if len(things) < options.least_matched or len(landmarks) < options.least_matched or not len(landmarks.cameras):
        return None
    search = _Search(things, landmarks, options)
    found = sorted((search.refine(k) for k in search.likeliest()), key=lambda one: -one.score)
    best = found[0]
    others = [one.score for one in found[1:] if _is_elsewhere(one.pose, best.pose, options)]
    sureness = float(things.scores.mean())
    looser = search.looseness(best) * options.sure / sureness  # what a detector is less sure of it also cuts out worse
    covariance = _covariance(best.pose, best.information, options) * looser
    return LandmarkPose(
        world_from_camera=invert_pose(best.pose),
        covariance=covariance,
        score=best.score,
        lead=best.score - max(others, default=0.0),
        matched=int(np.count_nonzero(best.assigned >= 0)),
        expected=search.expected(best.pose),
        sureness=sureness,
        measured=bool(np.isfinite(things.points).any()),
        sigma_m=float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        sigma_deg=float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))),
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Refined:
    score: float
    pose: FloatArray  # [4, 4] camera_from_world
    assigned: Int64Array  # [l] which box is of a landmark, -1 for none
    information: FloatArray  # [6, 6]


class _Search:
    """One image against one map."""

    def __init__(self, things: SeenThings, landmarks: MapLandmarks, options: LandmarkPoseOptions) -> None:
        self._things, self._landmarks, self._options = things, landmarks, options
        names = np.ascontiguousarray(landmarks.names[:, things.category])
        shapes = (landmarks.corners, landmarks.centres, landmarks.reach)
        seen = (things.boxes, things.category, things.scores, things.points, things.frame)
        self._given = (*shapes, landmarks.seen, names, *seen)
        self._fitted = (*shapes, things.boxes, things.points, things.frame)
        few = len(landmarks.cameras) <= options.most_keyframes
        chosen = np.linspace(0, len(landmarks.cameras) - 1, options.most_keyframes).round().astype(np.int64)
        self._cameras = landmarks.cameras if few else landmarks.cameras[chosen]
        pairs = poses_from_pairs(
            *(things.boxes, things.points, things.scores, names, landmarks.centres, landmarks.sizes),
            *(self._cameras, landmarks.level),
            ways_to_hold=options.ways_to_hold,
            slack=options.distance_slack,
            most=options.most_pairs,
        )
        aside = turned_cameras(self._cameras, landmarks.level, options.most_turned)
        self._starts = np.ascontiguousarray(np.concatenate([self._cameras, aside, pairs]))
        self._table = np.empty((len(landmarks), len(things)))
        self._widths = np.array(options.widths)

    def likeliest(self) -> list[int]:
        """The hypotheses that agree best, none of them close to a better one."""
        scores = np.empty(len(self._starts))
        kernels.agreements(*self._given, self._options.wide * self._landmarks.edge, self._starts, scores)
        order = np.argsort(-scores, kind="stable")[: 20 * self._options.refined]
        places, looks = _places(self._starts[order]), self._starts[order, 2, :3]
        chosen: list[int] = []
        for n in range(len(order)):
            near = np.linalg.norm(places[chosen] - places[n], axis=1) < 0.3
            if not (near & (looks[chosen] @ looks[n] > 0.985)).any():
                chosen.append(n)
                if len(chosen) == self._options.refined:
                    break
        return [int(order[n]) for n in chosen]

    def refine(self, start: int) -> _Refined:
        """A hypothesis where it agrees best; which box is of which landmark is found anew until it stays."""
        pose, assigned = self._starts[start].copy(), np.empty(len(self._landmarks), np.int64)
        information = np.zeros((6, 6))
        nearest = self._nearest(pose)
        level = self._landmarks.level
        edge, away = self._options.wide * self._landmarks.edge, 0.0
        score = kernels.agreement(*self._given, edge, pose, assigned, self._table)
        for turn in range(4):
            before = assigned.copy()
            away = kernels.refine(*self._fitted, edge, nearest, level, self._widths, assigned, pose, information)
            edge = self._landmarks.edge
            score = kernels.agreement(*self._given, edge, pose, assigned, self._table)
            if turn and np.array_equal(before, assigned):
                break
        return _Refined(float(score - self._options.near_weight * away), pose, assigned, information)

    def _nearest(self, pose: FloatArray) -> FloatArray:
        """The keyframe that is nearest in place and direction."""
        turned = np.linalg.norm((self._cameras[:, :3, :3] - pose[:3, :3]).reshape(-1, 9), axis=1)
        apart = np.linalg.norm(_places(self._cameras) - _places(pose[None]), axis=1)
        return np.ascontiguousarray(self._cameras[int(np.argmin(turned + 0.14 * apart))])

    def expected(self, pose: FloatArray) -> int:
        """How many landmarks lie in the image."""
        box, of = np.empty(4), self._landmarks
        inside = [kernels.predict(of.corners[m], of.centres[m], pose, self._things.frame, box) for m in range(len(of))]
        return sum(share >= kernels.LEAST_INSIDE for share in inside)

    def looseness(self, found: _Refined) -> float:
        """How much larger than one the squared residuals are, with usual ones: boxes of some images fit better."""
        off = np.zeros(5 * max(int(np.count_nonzero(found.assigned >= 0)), 1))
        count = kernels.residuals(*self._fitted, self._landmarks.edge, found.pose, found.assigned, off)
        off = np.minimum(np.abs(off[:count]), kernels.MOST_PULL)
        usual = self._options.usual_residuals
        return float((usual + (off * off).sum()) / (usual + np.count_nonzero(off)))


def _places(cameras: FloatArray) -> FloatArray:
    """Where cameras ``[n, 4, 4]`` (camera_from_world) are, ``[n, 3]``."""
    return np.asarray(-np.einsum("nji,nj->ni", cameras[:, :3, :3], cameras[:, :3, 3]), np.float64)


def _is_elsewhere(one: FloatArray, other: FloatArray, options: LandmarkPoseOptions) -> bool:
    apart = float(np.linalg.norm(_places(one[None]) - _places(other[None])))
    return apart > options.elsewhere_m or rotation_angle_deg(one[:3, :3] @ other[:3, :3].T) > options.elsewhere_deg


def _covariance(pose: FloatArray, information: FloatArray, options: LandmarkPoseOptions) -> FloatArray:
    """Of the camera in the world. Its position and rotation change against the step, which moves points before it."""
    local = np.linalg.inv(information + 1e-9 * np.eye(6)) * options.covariance_scale
    back = np.zeros((6, 6))
    back[:3, :3] = back[3:, 3:] = -pose[:3, :3].T
    found = back @ local @ back.T
    return np.asarray((found + found.T) / 2, np.float64)
