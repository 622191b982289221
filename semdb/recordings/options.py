"""What a user says about a recording that its files do not say, or say wrongly; and how that is written down."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from urllib.parse import quote, unquote

import numpy as np

from semdb.errors import UsageError
from semdb.geometry import invert_pose, pose_from, so3_exp
from semdb.types import FloatArray

WORLD_FROM_CAMERA, CAMERA_FROM_WORLD = "world_from_camera", "camera_from_world"
# The axes in which poses may be given, as the pose of the camera in them of an OpenCV camera (x right, y down,
# z forward): OpenGL and ARKit have y up and z back, a ROS body x forward, y left, z up (REP 103).
BACK = np.diag([1.0, -1.0, -1.0, 1.0])
BODY = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
AXES: Mapping[str, FloatArray] = {"opencv": np.eye(4), "opengl": BACK, "arkit": BACK, "ros": BODY}
QUATERNIONS = ("xyzw", "wxyz")
REVERSED = "reversed"
DEPTH_CAMERA_USAGE = "--depth-camera takes fx,fy,cx,cy or fx,fy,cx,cy,x,y,z"
BY_CAMERAS = "cameras"  # up is where the cameras' is


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How a recording is to be read where its files do not say; the defaults are what its format says.

    `depth_scale` is units per metre of depth files. `poses_are` and `axes` say what the poses in the files are of,
    `quaternion` in which order they have their numbers. `time_offset_ms` is added to the times of poses,
    `depth_offset_ms` to those of depth, to get those of colour; `times` "reversed" says that poses run backwards
    through them. `scale` is metres per unit of poses, `up` "x,y,z" (or "cameras") the direction in their world that
    becomes z. `depth_camera` "fx,fy,cx,cy[,x,y,z]" is where depth files are from. Topics and frames are of ROS bags.
    """

    depth_scale: float | None = None
    poses_are: str = WORLD_FROM_CAMERA
    axes: str | None = None
    quaternion: str | None = None
    time_offset_ms: float = 0.0
    depth_offset_ms: float = 0.0
    times: str | None = None
    scale: float | None = None
    up: str | None = None
    depth_camera: str | None = None
    color_topic: str | None = None
    depth_topic: str | None = None
    info_topic: str | None = None
    world_frame: str | None = None

    def __post_init__(self) -> None:
        _check_choice("--poses-are", self.poses_are, (WORLD_FROM_CAMERA, CAMERA_FROM_WORLD))
        _check_choice("--axes", self.axes, tuple(AXES))
        _check_choice("--quaternion", self.quaternion, QUATERNIONS)
        _check_choice("--times", self.times, (REVERSED,))
        if self.up is not None:
            self.turn([])
        if self.depth_camera is not None:
            numbers_in(self.depth_camera, (4, 7), DEPTH_CAMERA_USAGE)
        for name in ("depth_scale", "scale"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise UsageError(f"{option_of(name)} must be a positive number, but is {value}")
        for name in ("time_offset_ms", "depth_offset_ms"):
            if not abs(getattr(self, name)) < 1e12:
                raise UsageError(f"{option_of(name)} must be a number of milliseconds, but is {getattr(self, name)}")

    def given(self) -> dict[str, str]:
        """The options that are not as by default, as text."""
        pairs = ((field, getattr(self, field.name)) for field in fields(self))
        return {
            field.name: repr(value) if isinstance(value, float) else str(value)
            for field, value in pairs
            if value != field.default
        }

    def pose(self, pose: FloatArray) -> FloatArray:
        """``world_from_camera`` ``[4, 4]`` of an OpenCV camera from a pose as the files have it."""
        found = invert_pose(pose) if self.poses_are == CAMERA_FROM_WORLD else pose
        if self.axes is not None:
            found = np.asarray(found @ AXES[self.axes])
        if self.scale is not None:
            found = pose_from(found[:3, :3], found[:3, 3] * self.scale)
        return found

    def turn(self, poses: Sequence[FloatArray]) -> FloatArray | None:
        """What turns the world of `poses` (``[4, 4]``, read already) so that `up` becomes z; None where nobody said up.

        Raises UsageError for what is no direction, or where "cameras" have none in common.
        """
        if self.up is None:
            return None
        if self.up == BY_CAMERAS:
            return upright(-np.mean([pose[:3, 1] for pose in poses], axis=0)) if len(poses) else np.eye(4)
        return upright(numbers_in(self.up, (3,), f"--up takes x,y,z or {BY_CAMERAS}"))

    @property
    def changes_poses(self) -> bool:
        """Whether `pose` does anything."""
        return self.poses_are != WORLD_FROM_CAMERA or self.axes not in (None, "opencv") or self.scale is not None


def numbers_in(text: str, counts: tuple[int, ...], usage: str) -> FloatArray:
    """Finite numbers between commas, as many as one of `counts`. Raises UsageError that begins with `usage`."""
    try:
        found = np.array([float(part) for part in text.split(",")])
    except ValueError:
        found = np.empty(0)
    if len(found) not in counts or not np.isfinite(found).all():
        raise UsageError(f"{usage}, but is {text!r}")
    return found


def upright(up: FloatArray) -> FloatArray:
    """The shortest turn ``[4, 4]`` that makes z of the direction `up`. Raises UsageError where it has none."""
    length = float(np.linalg.norm(up))
    if not length > 1e-3:
        raise UsageError(f"--up {','.join(f'{value:g}' for value in up)}: no direction is up in it; give x,y,z")
    unit = up / length
    axis = np.cross(unit, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        axis, sine = np.array([1.0, 0.0, 0.0]), 1.0  # z already, or a half turn about x
    return pose_from(
        so3_exp(axis / sine * np.arctan2(np.linalg.norm(np.cross(unit, [0.0, 0.0, 1.0])), unit[2])), np.zeros(3)
    )


def option_of(name: str) -> str:
    """The command line's name of an option: ``--depth-scale`` of depth_scale."""
    return f"--{name.replace('_', '-')}"


def write_options(options: ReadOptions) -> str:
    """What is not as by default as one line ``depth_scale=1000&axes=ros``; "" where everything is."""
    return "&".join(f"{name}={quote(value, safe='/')}" for name, value in options.given().items())


def read_options(text: str) -> ReadOptions:
    """The options of `write_options`. Raises UsageError for what is none."""
    kinds = {field.name: field.type for field in fields(ReadOptions)}
    found: dict[str, object] = {}
    for part in filter(None, text.split("&")):
        name, _, value = part.partition("=")
        if name not in kinds:
            raise UsageError(f"{name!r} is no option of a recording")
        value = unquote(value)
        try:
            found[name] = float(value) if "float" in str(kinds[name]) else value
        except ValueError as error:
            raise UsageError(f"{option_of(name)}: {value!r} is no number") from error
    return replace(ReadOptions(), **found)  # type: ignore[arg-type]


def _check_choice(option: str, value: str | None, known: tuple[str, ...]) -> None:
    if value is not None and value not in known:
        raise UsageError(f"{option} {value}: known are {', '.join(known)}")


AS_THE_FORMAT_SAYS = ReadOptions()
