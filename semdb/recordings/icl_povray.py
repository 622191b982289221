"""ICL-NUIM as POV-Ray rendered it: ``scene_00_0000.png``, ``.depth`` and ``.txt`` of each frame, in one folder.

A ``.depth`` file is text: for each pixel, row by row, the distance to the surface along the ray. A ``.txt`` file has
POV-Ray's camera: ``cam_pos``, ``cam_dir``, ``cam_up`` and ``cam_right``. The image plane is as wide as ``cam_right`` is
long and as high as ``cam_up``, at the distance ``cam_dir``; ``cam_angle`` is not what the images were rendered with.
POV-Ray's world is left-handed with y up; it is mirrored as that of the other layout is (`semdb.recordings.icl_nuim`).
The living room is in metres, the office and the trajectories of other frame rates in centimetres.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.files import UnusableFileError, parse_number, read_text
from semdb.geometry import pixels_to_normalized, pose_from
from semdb.recordings.assembly import Draft, finish, use_camera_file
from semdb.recordings.base import FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.cameras import ICL_NUIM
from semdb.recordings.icl_nuim import pose_from_icl
from semdb.recordings.images import inspect_file, read_bytes
from semdb.recordings.numbered import entries_of
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import SCALE, as_raw
from semdb.recordings.poses import rigid_pose
from semdb.shown import number
from semdb.types import Camera, Float32Array, FloatArray

NAME = re.compile(r"scene_(?:[0-9]{1,3}_)?([0-9]{1,9})")
VECTOR = re.compile(r"\b(cam_[a-z]+)\s*=\s*\[([^\]]*)\]")
WANTED = ("cam_pos", "cam_dir", "cam_up", "cam_right")
CENTIMETRES = 0.01
FARTHEST_ROOM = 30.0  # units: a median distance beyond it is one in centimetres
LOOKED_AT, DISTANCES_APART = 5, 97  # files that are tried for it, and pixels
SAME_VIEW = 0.005  # by which focal lengths of frames may differ


@dataclass(frozen=True, slots=True, eq=False)
class PovCamera:
    """Position and axes (right, up, forward; unit) in POV-Ray's world, and the image plane over its distance."""

    pose: FloatArray  # [4, 4], right-up-forward, left-handed
    width: float
    height: float


def is_povray(path: Path) -> bool:
    """Whether a folder has frames named as ICL-NUIM's, with distances or POV-Ray's cameras beside them."""
    if not path.is_dir():
        return False
    return any(NAME.fullmatch(file.stem) for kind in ("depth", "txt") for file in path.glob(f"scene_*.{kind}"))


def open_povray(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of the frames of a folder by their number. Raises RecordingError."""
    options = options or ReadOptions()
    color, depth, texts = (_files(path, kind) for kind in ("png", "depth", "txt"))
    if not color:
        raise RecordingError(f"{path}: has no images scene_00_0000.png, ..., as ICL-NUIM has beside its other files")
    found = {index: _read_camera(file) for index, file in texts.items()}
    right = [item for item in found.values() if isinstance(item, PovCamera)]
    unit, why = _unit(depth, options)
    poses = {index: item if isinstance(item, str) else _pose(item, unit, options) for index, item in found.items()}
    entries, dropped = entries_of(path, color, depth or None, poses or None)
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="icl_povray",
        total_frames=len(color),
        entries=entries,
        dropped=dropped,
        known_camera=ICL_NUIM,
        depth_scale=SCALE,
    )
    if right:
        draft.known_camera = _camera_of(path, next(iter(color.values())), right)
    if not use_camera_file(draft, camera, options, path) and camera is None and not right:
        draft.assumed.append("camera: that of ICL-NUIM, 481.2,480,319.5,239.5")
    draft.depth_scale, draft.assumed_scale = SCALE, ""  # of what is stored; the files have real numbers
    if right:
        draft.assumed.append("poses: POV-Ray's world is left-handed with y up, as ICL-NUIM's, and is mirrored")
    else:
        draft.notes.append("no scene_*.txt: the frames have no pose")
    if why:
        draft.assumed.append(why)
    if not depth:
        draft.notes.append("no scene_*.depth: the frames have no depth")
    data = draft.data = _PovrayData(unit)
    recording = finish(draft, camera)
    data.camera = recording.camera
    return recording


class _PovrayData:
    """Images, and distances along rays, which become depth."""

    def __init__(self, unit: float) -> None:
        self._unit = unit
        self.camera: Camera | None = None

    def color(self, entry: FrameEntry) -> RawColor:
        return RawColor(file=read_bytes(entry.image_path))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        if entry.depth_path is None or self.camera is None:
            return None
        distance = read_distances(entry.depth_path, self.camera.width * self.camera.height)
        return as_raw(along_axis(self.camera, distance * np.float32(self._unit)))


def read_distances(path: Path, count: int) -> Float32Array:
    """The `count` numbers of a ``.depth`` file, NaN for what is not positive. Raises FrameError that names it."""
    try:
        values = np.array(read_text(path).split(), dtype=np.float32)
    except UnusableFileError as error:
        raise FrameError(str(error.at(path))) from error
    except ValueError as error:
        raise FrameError(f"{path}: has something that is no number") from error
    if len(values) != count:
        raise FrameError(f"{path}: has {len(values)} distances, but the image has {count} pixels")
    return np.where(np.isfinite(values) & (values > 0), values, np.float32(np.nan))


def along_axis(camera: Camera, distance: Float32Array) -> Float32Array:
    """Depth ``[H, W]`` metres of distances ``[H * W]`` along the rays of all pixels."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    rays = pixels_to_normalized(camera, np.column_stack([columns.ravel(), rows.ravel()]))
    depth: FloatArray = distance / np.sqrt(1 + (rays * rays).sum(axis=1))
    return depth.reshape(camera.height, camera.width).astype(np.float32)


def _files(path: Path, kind: str) -> dict[int, Path]:
    """Files by frame number; of several of a number (one for each blur sample) the first."""
    found: dict[int, Path] = {}
    for file in sorted(path.glob(f"scene_*.{kind}")):
        if name := NAME.fullmatch(file.stem):
            found.setdefault(int(name[1]), file)
    return found


def _read_camera(file: Path) -> PovCamera | str:
    """POV-Ray's camera of a file, or the reason why there is none."""
    try:
        text = read_text(file, escape=True)
        vectors = {name: _vector(values) for name, values in VECTOR.findall(text)}
        for name in WANTED:
            if name not in vectors:
                raise ValueError(f"has no {name}")
        forward, up, across = (vectors[name] for name in WANTED[1:])
        sizes = [float(np.linalg.norm(vector)) for vector in (forward, up, across)]
        right = np.cross(up, forward)
        if not (min(sizes) > 1e-6 and np.linalg.norm(right) > 1e-3 * sizes[0] * sizes[1]):
            raise ValueError("has a camera without direction")
        z, x = forward / sizes[0], right / np.linalg.norm(right)
        turn = np.column_stack([x, np.cross(z, x), z, vectors["cam_pos"]])
        return PovCamera(rigid_pose(turn), sizes[2] / sizes[0], sizes[1] / sizes[0])
    except UnusableFileError as error:
        return f"{file.name}: {error}"
    except ValueError as error:
        return f"{file.name}: {error}"


def _vector(text: str) -> FloatArray:
    """Three numbers between commas. Raises ValueError with the reason."""
    values = np.array([parse_number(part) for part in text.replace(",", " ").split()])
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"has no three numbers in [{text[:40]}]")
    return values


def _pose(found: PovCamera, unit: float, options: ReadOptions) -> FloatArray:
    turn, place = found.pose[:3, :3], found.pose[:3, 3] * unit
    return pose_from_icl(replace(options, scale=None).pose(pose_from(turn, place)))


def _camera_of(path: Path, image: Path, found: list[PovCamera]) -> Camera:
    """The camera that all frames have. Raises RecordingError."""
    try:
        width, height = inspect_file(image).size
    except FrameError as error:
        raise RecordingError(f"{image}: {error}") from error
    views = np.array([(item.width, item.height) for item in found])
    if (np.abs(views / views[0] - 1) > SAME_VIEW).any():
        raise RecordingError(f"{path}: the cameras in scene_*.txt have different focal lengths; --camera gives one")
    across, up = np.median(views, axis=0)
    return Camera(width, height, width / across, height / up, (width - 1) / 2, (height - 1) / 2)


def _unit(depth: dict[int, Path], options: ReadOptions) -> tuple[float, str]:
    """Metres a unit of positions and distances, and for people why, where nothing says it."""
    if options.scale is not None:
        return options.scale, ""
    for file in list(depth.values())[:LOOKED_AT]:
        try:
            values = np.array(read_text(file).split()[::DISTANCES_APART], dtype=np.float32)
        except (UnusableFileError, ValueError):
            continue
        known = values[np.isfinite(values) & (values > 0)]
        if len(known):
            middle = float(np.median(known))
            unit, name = (CENTIMETRES, "centimetres") if middle > FARTHEST_ROOM else (1.0, "metres")
            return (
                unit,
                f"scale: {name}, as half of {file.name} is within {number(middle)} units; --scale gives another",
            )
    return 1.0, "scale: metres, as nothing says otherwise; --scale gives another"


LAYOUT = Layout(
    "icl_povray",
    "ICL-NUIM as POV-Ray rendered it (scene_00_0000.png, .depth, .txt)",
    is_povray,
    lambda path, camera, options: [open_povray(path, camera, options)],
    frozenset({"scale", "poses_are", "axes"}),
)
