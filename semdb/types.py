"""The frozen values that pass between rooms.

Conventions, everywhere: poses are ``world_from_camera`` (4x4 float64, metres, camera axes x right, y down,
z forward) of the colour camera; the centre of the top-left pixel is (0, 0); depth is float32 metres with NaN
where invalid; images are uint8 RGB ``[H, W, 3]``; timestamps are integer nanoseconds; angles of keypoints are
degrees, clockwise in the image as in OpenCV; quaternions say their order in their name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int32]
Int64Array = npt.NDArray[np.int64]
ImageArray = npt.NDArray[np.uint8]
BoolArray = npt.NDArray[np.bool_]

FROM_MEMORY = "frames"  # format of recordings whose frames a program gave: nobody else can read them again


@dataclass(frozen=True, slots=True)
class Camera:
    """A pinhole camera with OpenCV's radial-tangential distortion (k1, k2, p1, p2, k3), or none: ``()``.

    ``fx, fy, cx, cy`` are pixels. `fy` is positive: readers turn data sets with another convention.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def model(self) -> str:
        """``PINHOLE`` without, ``OPENCV`` with distortion."""
        return "OPENCV" if any(self.distortion) else "PINHOLE"

    @property
    def matrix(self) -> FloatArray:  # [3, 3]
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class InstanceMasks:
    """Object masks that come with a recording: ``labels[H, W]`` (0 is background) and a class name per label."""

    labels: npt.NDArray[np.uint16]
    categories: Mapping[int, str]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One decoded frame of a recording.

    `index` is stable: it does not depend on which other frames can be used. `depth` ``[H, W]`` is registered to
    the colour image. `image_bytes` and `depth_bytes` are the files as recorded; ``depth_scale`` is units per
    metre of those; `depth_registration` names what was done to them to get `depth` ("" for nothing).
    """

    index: int
    name: str
    timestamp_ns: int | None
    image: ImageArray
    depth: Float32Array | None
    camera: Camera
    world_from_camera: FloatArray | None
    instances: InstanceMasks | None = None
    image_bytes: bytes = b""
    depth_bytes: bytes | None = None
    depth_scale: float | None = None
    depth_registration: str = ""


@dataclass(frozen=True, slots=True)
class Sighting:
    """Something that a detector saw, sure or not: evidence of a class, whether it is kept as an object or not."""

    category: str
    score: float
    height: float  # of the centre of its box, 0 at the top of the image, 1 at the bottom
    box: tuple[float, float, float, float] | None = field(default=None, compare=False)  # as of a detection


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One object in an image: COCO-style class name, score 0..1, box x1, y1, x2, y2 (last pixel inside), mask.

    A `weak` one has too low a score to be kept as an object, and no mask.
    """

    category: str
    score: float
    box: Float32Array  # [4]
    mask: BoolArray  # [H, W]; [0, 0] of a weak one
    weak: bool = False

    def sighting(self, height: int) -> Sighting:
        """What it says of its class in an image of `height` pixels."""
        x1, y1, x2, y2 = (float(value) for value in self.box)
        return Sighting(self.category, self.score, (y1 + y2 + 1) / (2 * height), (x1, y1, x2, y2))


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """What a local feature finds in a grey image, before it is known on which object it lies."""

    xy: Float32Array  # [n, 2] pixels, as seen (distorted)
    size: Float32Array  # [n] diameter, pixels
    angle: Float32Array  # [n] degrees, -1 where the feature has none
    response: Float32Array  # [n]
    laplacian: npt.NDArray[np.int8]  # [n] -1, 0 (unknown) or 1
    descriptors: npt.NDArray[np.generic]  # [n, d] float32, uint8 of bits, int8 (byte_descriptors)

    def __len__(self) -> int:
        return len(self.xy)


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """Features of one image sorted by object, each with its 3D point.

    `object_index` ``[n]`` is the ordinal of the detection the keypoint lies on, -1 for the background; objects
    come first in ascending order, the background last, so that an object is a slice.
    `points` ``[n, 3]`` are metres in the camera frame, NaN where depth is missing or at a depth edge.
    """

    features: Features
    object_index: IntArray
    points: Float32Array

    def __len__(self) -> int:
        return len(self.features)


@dataclass(frozen=True, slots=True)
class ModelInfo:
    """Provenance: which network or feature made something. Equal infos make comparable rows."""

    role: str  # "detector", "encoder" or "features"
    name: str  # the spec without machine paths, e.g. "onnx:mask_rcnn_2go.onnx", "gist", "surf"
    sha256: str  # of the weights file; "" where there is none
    config: str = "{}"  # canonical JSON (sorted keys) of what changes the output


@dataclass(frozen=True, slots=True, eq=False)
class ObjectGeometry:
    """Where an object is, from the depth under its mask, in the camera frame; NaN where there is no depth."""

    pixel_area: int
    centroid: FloatArray  # [3] metres, median of the points
    extent: FloatArray  # [3] metres, axis-aligned in the camera frame, 5th to 95th percentile


@dataclass(frozen=True, slots=True)
class ImageQuality:
    """How good an image is (`semdb.perception.quality`)."""

    sharpness: float  # mean squared gradient, grey values per pixel
    exposure: float  # mean grey, 0 black to 1 white
    contrast: float  # from the 5th to the 95th percentile of the grey values, 0 to 1
    blur_px: float  # length of the motion that blurs it, 0 where there is none
    blur_deg: float  # its direction, from x towards y, 0 to 180


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """All that semdb knows of one image. Made by `semdb.perception.describe`, for keyframes and queries alike."""

    camera: Camera
    detections: tuple[Detection, ...]
    geometry: tuple[ObjectGeometry, ...]  # one per detection
    keypoints: Keypoints
    cnn_vector: Float32Array  # [d], L2-normalised
    models: tuple[ModelInfo, ...]  # detector, encoder, features
    timing_ms: Mapping[str, float] = field(default_factory=dict)  # detect, encode, features
    grey: ImageArray | None = None  # [H, W] the image in grey, to look at its pixels again; not stored
    depth: Float32Array | None = None  # [H, W] metres, NaN where there is none; not stored
    sightings: tuple[Sighting, ...] | None = None  # all that the detector saw; None: the detections
    dynamic: frozenset[str] = frozenset()  # categories of objects that move: they say nothing about a place
    stretch: tuple[float, float] | None = None  # grey values that are 0 and 255 in `grey`, where contrast was stretched

    @property
    def category_counts(self) -> dict[str, int]:
        counts: dict[str, int] = {}
        for detection in self.detections:
            if detection.category not in self.dynamic:
                counts[detection.category] = counts.get(detection.category, 0) + 1
        return counts

    @property
    def evidence(self) -> list[tuple[str, float, float]]:
        """Class, score and height in the image (0 top, 1 bottom) of all that was seen and does not move."""
        seen = self.sightings
        if seen is None:
            seen = tuple(d.sighting(self.camera.height) for d in self.detections)
        return [(s.category, s.score, s.height) for s in seen if s.category not in self.dynamic]


class Verdict(StrEnum):
    LOCALIZED = "localized"
    AMBIGUOUS = "ambiguous"
    COARSE = "coarse"  # a pose by landmarks alone, good to half a metre
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far poses may differ that are one for the caller."""

    metres: float
    degrees: float


@dataclass(frozen=True, slots=True, eq=False)
class ConsistentPose:
    """A pose elsewhere that the image fits too, with so many keypoints."""

    world_from_camera: FloatArray
    inliers: int


@dataclass(frozen=True, slots=True)
class Candidate:
    """A keyframe that the coarse step proposed, and what the fine step made of it."""

    keyframe_id: int
    recording: str
    frame_index: int
    class_score: float  # 0..1: shared idf-weighted objects over those of the query
    cosine: float  # NaN where it was not ranked
    inliers: int = 0  # 0 where it was not matched


@dataclass(frozen=True, slots=True)
class PoseErrors:
    """How far the poses of a recording are off the images of its keyframes: standard deviations along an axis, of a
    pose at a distance (`pose_distances`) of 1 from them.

    The freedoms are how many numbers of keyframes' poses told: 0, nothing is known.
    """

    position_m: float
    rotation_rad: float
    position_freedom: float
    rotation_freedom: float
    keyframes: int = 0  # that were localized among the others


@dataclass(frozen=True, slots=True, eq=False)
class Localization:
    """The answer to one query. `world_from_camera` and `covariance` are None when the verdict is `failed`.

    `covariance` ``[6, 6]``: translation (m) then rotation (rad, left perturbation in the world frame).
    """

    verdict: Verdict
    map_name: str
    world_from_camera: FloatArray | None
    covariance: FloatArray | None
    confidence: float
    inliers: int
    stage: str  # which stage of the cascade answered: "filtered", "soft", "all"
    candidates: tuple[Candidate, ...]
    ranked_share: float
    keyframes_matched: int
    reason: str  # one line for people: why this verdict
    timing_ms: Mapping[str, float]
    evidence: Mapping[str, float] = field(default_factory=dict)  # what verdict and confidence were made from
    refinements: Mapping[str, str] = field(default_factory=dict)  # what became of those of the map: used, stale, none
    others: tuple[ConsistentPose, ...] = ()  # poses elsewhere that stand against this one, most keypoints first
    # for plots: the best keyframe and its inlier pairs (pixels as seen)
    best_keyframe_id: int | None = None
    query_xy: Float32Array | None = None  # [m, 2]
    keyframe_xy: Float32Array | None = None  # [m, 2]
