"""What a database answers with: frozen values, which draw themselves where a notebook shows them."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np

from semdb.door.matched import MatchedPixels
from semdb.errors import UsageError
from semdb.geometry import quat_wxyz_from_rotation, transform_points
from semdb.shown import for_terminal, measure
from semdb.types import (
    BoolArray,
    Camera,
    Candidate,
    ConsistentPose,
    Detection,
    Float32Array,
    FloatArray,
    ImageArray,
    Keypoints,
    Verdict,
)

Row = tuple[Any, ...]


@dataclass(frozen=True, slots=True, eq=False)
class SeenObject:
    """An object in an image: its class, the detector's score 0..1, box x1, y1, x2, y2 in pixels (last one inside).

    `position` ``[3]`` is its centre in metres in the map, None where depth or pose are missing; `extent` ``[3]`` its
    size in metres along the axes of the camera. `id` is that of its row, None for an object of a query.
    """

    category: str
    score: float
    box: Float32Array  # [4]
    position: FloatArray | None
    extent: FloatArray | None
    id: int | None = None
    size: tuple[int, int] = field(default=(0, 0), repr=False)  # width and height of the mask
    packed: bytes = field(default=b"", repr=False)  # the mask, eight pixels a byte

    @classmethod
    def of(
        cls,
        category: str,
        score: float,
        box: Float32Array,
        mask: BoolArray,
        *,
        centroid: FloatArray,
        extent: FloatArray,
        world_from_camera: FloatArray | None,
        row_id: int | None = None,
    ) -> Self:
        """The object with `mask` ``[H, W]``; `centroid` and `extent` ``[3]`` are metres in the camera's frame."""
        known = bool(np.isfinite(centroid).all())
        position = None
        if known and world_from_camera is not None:
            position = frozen(transform_points(world_from_camera, centroid[None])[0])
        return cls(
            category,
            float(score),
            frozen(box),
            position,
            frozen(extent) if known else None,
            row_id,
            (mask.shape[1], mask.shape[0]),
            np.packbits(mask).tobytes(),
        )

    @property
    def mask(self) -> BoolArray:
        """The pixels of the object, bool ``[H, W]``."""
        width, height = self.size
        bits = np.unpackbits(np.frombuffer(self.packed, np.uint8), count=width * height)
        return bits.reshape(height, width).astype(np.bool_)

    def detection(self) -> Detection:
        """The object as detectors give it."""
        return Detection(self.category, self.score, self.box, self.mask)

    def __repr__(self) -> str:
        where = "" if self.position is None else f" at {_numbers(self.position)} m"
        return for_terminal(f"<{self.category} {self.score:.2f}{where}>")


class Posed:
    """What a pose and its covariance say; both are None where there is no pose."""

    __slots__ = ()
    world_from_camera: FloatArray | None
    covariance: FloatArray | None

    @property
    def position(self) -> FloatArray | None:
        """x, y, z ``[3]`` of the camera in the map, metres."""
        return None if self.world_from_camera is None else self.world_from_camera[:3, 3]

    @property
    def quat_wxyz(self) -> FloatArray | None:
        """The rotation ``world_from_camera`` as a quaternion ``[4]``."""
        return None if self.world_from_camera is None else quat_wxyz_from_rotation(self.world_from_camera[:3, :3])

    @property
    def sigma_m(self) -> float:
        """The standard deviation of the position along its least certain direction, metres; NaN without a pose."""
        return _largest_sigma(self.covariance, 0)

    @property
    def sigma_deg(self) -> float:
        """The standard deviation of the rotation about its least certain axis, degrees; NaN without a pose."""
        return math.degrees(_largest_sigma(self.covariance, 3))


@dataclass(frozen=True, slots=True, eq=False)
class Answer(Posed):
    """Where an image was taken. `world_from_camera` ``[4, 4]`` and `covariance` ``[6, 6]`` are None for `failed`.

    The pose is metres in the map's world frame, camera axes x right, y down, z forward; the covariance is of
    translation (m), then rotation (rad, left perturbation in the world frame). `confidence` is the probability 0..1
    that the pose is right. `objects` are those that were seen in the image, `candidates` the keyframes that were looked
    at, `others` the poses elsewhere that stand against this one, most keypoints first. `timing_ms` has the wall time of
    each part and their `total`. Of a frame of a recording `frame_index` is its number and `timestamp_ns` its time,
    where the recording has times.
    """

    image: str  # its path, or the name that was given with the array
    verdict: Verdict
    map: str
    world_from_camera: FloatArray | None
    covariance: FloatArray | None
    confidence: float
    inliers: int
    stage: str
    reason: str
    objects: tuple[SeenObject, ...]
    candidates: tuple[Candidate, ...]
    ranked_share: float
    keyframes_matched: int
    refinements: Mapping[str, str]
    timing_ms: Mapping[str, float]
    frame_index: int | None = None
    timestamp_ns: int | None = None
    others: tuple[ConsistentPose, ...] = ()
    matches: MatchedPixels | None = None  # with the best keyframe; None where none was matched, or was not asked for
    draw: Callable[[], ImageArray] | None = field(default=None, repr=False)

    @property
    def localized(self) -> bool:
        """Whether the pose is to be relied on: the verdict is ``localized``."""
        return self.verdict is Verdict.LOCALIZED

    def picture(self) -> ImageArray:
        """Query and best keyframe with objects and matches, the map from above: RGB uint8 ``[H, W, 3]``.

        Reads the keyframe from the database. Raises DatabaseError, also when that is closed.
        """
        if self.draw is None:
            raise ValueError("this answer has no picture")
        return self.draw()

    def save(self, path: str | Path) -> Path:
        """Writes the picture as a PNG or JPEG file. Returns its path."""
        return save_image(self.picture(), path)

    def as_dict(self) -> dict[str, Any]:
        """What ``semdb localize --json`` prints for an image."""
        return {
            "image": self.image,
            "frame_index": self.frame_index,
            "timestamp_ns": self.timestamp_ns,
            "verdict": str(self.verdict),
            "map": self.map,
            "pose": None
            if self.position is None or self.quat_wxyz is None
            else {"position": self.position.tolist(), "quat_wxyz": self.quat_wxyz.tolist()},
            "others": [
                {
                    "position": other.world_from_camera[:3, 3].tolist(),
                    "quat_wxyz": quat_wxyz_from_rotation(other.world_from_camera[:3, :3]).tolist(),
                    "inliers": other.inliers,
                }
                for other in self.others
            ],
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "confidence": self.confidence,
            "inliers": self.inliers,
            "stage": self.stage,
            "reason": self.reason,
            "ranked_share": self.ranked_share,
            "keyframes_matched": self.keyframes_matched,
            "candidates": [
                {
                    "keyframe": candidate.keyframe_id,
                    "recording": candidate.recording,
                    "frame_index": candidate.frame_index,
                    "class_score": candidate.class_score,
                    "cosine": candidate.cosine,
                    "inliers": candidate.inliers,
                }
                for candidate in self.candidates
            ],
            "refinements": dict(self.refinements),
            "timing_ms": dict(self.timing_ms),
        }

    def __repr__(self) -> str:
        confidence = measure(self.confidence, 2, unless=(0.0, 1.0))
        where = f"{self.verdict} (confidence {confidence}) in map {self.map}"
        if self.position is not None:
            where += f" at {_numbers(self.position)} m, sigma {1000 * self.sigma_m:.1f} mm {self.sigma_deg:.2f} deg"
        spent = self.timing_ms.get("total", math.nan)
        return for_terminal(f"<{self.image}: {where}; {len(self.objects)} objects, {spent:.0f} ms>")

    def _repr_png_(self) -> bytes | None:
        return None if self.draw is None else png_bytes(self.picture())


class KeyframeContent(Protocol):
    """Reads what a keyframe holds. Raises NotFoundError where it was deleted, DatabaseError."""

    def image(self, keyframe_id: int) -> ImageArray: ...

    def depth(self, keyframe_id: int, camera: Camera) -> Float32Array | None: ...

    def objects(self, keyframe_id: int) -> tuple[SeenObject, ...]: ...

    def keypoints(self, keyframe_id: int) -> tuple[Keypoints, tuple[str, ...]]: ...


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A keyframe. What is large is read from the database when it is first asked for, and then kept.

    `world_from_camera` ``[4, 4]`` is metres in the map, of the colour camera. Reading raises NotFoundError where the
    keyframe was deleted meanwhile, DatabaseError.
    """

    id: int
    map: str
    recording: str
    frame_index: int
    timestamp_ns: int | None
    camera: Camera
    world_from_camera: FloatArray  # [4, 4]
    content: KeyframeContent = field(repr=False)
    kept: dict[str, Any] = field(default_factory=dict, repr=False)

    @property
    def position(self) -> FloatArray:
        """x, y, z ``[3]`` of the camera in the map, metres."""
        return self.world_from_camera[:3, 3]

    @property
    def image(self) -> ImageArray:
        """The colour image, RGB uint8 ``[H, W, 3]``, as recorded."""
        found: ImageArray = self._kept("image", lambda: frozen(self.content.image(self.id)))
        return found

    @property
    def depth(self) -> Float32Array | None:
        """Depth registered to the image, float32 ``[H, W]`` metres, NaN where nothing was measured; None without."""

        def read() -> Float32Array | None:
            depth = self.content.depth(self.id, self.camera)
            return None if depth is None else frozen(depth)

        found: Float32Array | None = self._kept("depth", read)
        return found

    @property
    def objects(self) -> tuple[SeenObject, ...]:
        """What the detector saw, with masks, by ordinal."""
        found: tuple[SeenObject, ...] = self._kept("objects", lambda: self.content.objects(self.id))
        return found

    @property
    def keypoints(self) -> Keypoints:
        """Local features with their 3D points in the camera's frame, without descriptors (``[n, 0]``).

        ``object_index`` ``[n]`` is the position in `objects` and `categories`, -1 in the background.
        """
        found: Keypoints = self._kept("keypoints", lambda: self.content.keypoints(self.id))[0]
        return found

    @property
    def categories(self) -> tuple[str, ...]:
        """The class of each object, by ordinal."""
        found: tuple[str, ...] = self._kept("keypoints", lambda: self.content.keypoints(self.id))[1]
        return found

    def picture(self) -> ImageArray:
        """The image with its objects, RGB uint8 ``[H, W, 3]``."""
        from semdb.pictures.drawing import description_facts, draw_image

        title = f"keyframe {self.id}: {self.recording}, frame {self.frame_index}"
        facts = description_facts(len(self.objects), self.keypoints)
        return draw_image(self.image, [thing.detection() for thing in self.objects], title=title, facts=facts)

    def save(self, path: str | Path) -> Path:
        """Writes the picture as a PNG or JPEG file. Returns its path."""
        return save_image(self.picture(), path)

    def __repr__(self) -> str:
        which = f"{self.recording} frame {self.frame_index} of map {self.map}"
        return for_terminal(f"<keyframe {self.id}: {which} at {_numbers(self.position)} m>")

    def _repr_png_(self) -> bytes:
        return png_bytes(self.picture())

    def _kept(self, name: str, read: Callable[[], Any]) -> Any:
        if name not in self.kept:
            self.kept[name] = read()
        return self.kept[name]


class Rows:
    """The rows of a statement, fetched while they are iterated over: each a tuple, in the order of `columns`.

    Closing it, or leaving its ``with``, ends the statement early.
    """

    def __init__(self, columns: tuple[str, ...], rows: Generator[Row, None, None]) -> None:
        self.columns = columns
        self._rows = rows

    def __iter__(self) -> Iterator[Row]:
        return self._rows

    def dicts(self) -> Iterator[dict[str, Any]]:
        """The rows as dicts by column."""
        return (dict(zip(self.columns, row, strict=True)) for row in self._rows)

    def close(self) -> None:
        """Ends the statement; there are no more rows then."""
        self._rows.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return for_terminal(f"<rows of {', '.join(self.columns)}>")


def frozen(array: Any) -> Any:
    """A copy of `array` that cannot be written to; `array` itself where it is one."""
    if array.flags.writeable:
        array = array.copy()
        array.flags.writeable = False
    return array


def png_bytes(picture: ImageArray) -> bytes:
    """RGB ``[H, W, 3]`` as a PNG file."""
    return encode(picture, ".png")


def save_image(picture: ImageArray, path: str | Path) -> Path:
    """Writes RGB ``[H, W, 3]`` as ``.png`` or ``.jpg``. Returns the path. Raises UsageError for another ending."""
    path = Path(path)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise UsageError(f"{path}: pictures are written as .png or .jpg")
    path.write_bytes(encode(picture, path.suffix))
    return path


def encode(picture: ImageArray, kind: str) -> bytes:
    """RGB ``[H, W, 3]`` as a file of a `kind` such as ``.png``."""
    import cv2

    return bytes(cv2.imencode(kind, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1])


def _numbers(values: FloatArray) -> str:
    return " ".join(f"{value:.3f}" for value in values)


def _largest_sigma(covariance: FloatArray | None, start: int) -> float:
    """Square root of the largest eigenvalue of one half ``[3, 3]`` of a covariance ``[6, 6]``."""
    if covariance is None:
        return math.nan
    return math.sqrt(max(0.0, float(np.linalg.eigvalsh(covariance[start : start + 3, start : start + 3])[-1])))
