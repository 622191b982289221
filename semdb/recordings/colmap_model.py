"""A model of COLMAP with its images: keyframes without depth. Its units are metres only where somebody says so."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semdb.errors import RecordingError, UsageError
from semdb.files import read_text
from semdb.geometry import invert_pose
from semdb.recordings.assembly import Draft, finish
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.colmap_files import ColmapModel, model_folder, read_model
from semdb.recordings.images import decode_color, read_bytes
from semdb.recordings.lens import Lens, Straightener, as_camera
from semdb.recordings.options import ReadOptions
from semdb.types import Camera

METRIC = "# 1 unit is 1 metre"  # a line of cameras.txt in models that semdb wrote


def is_colmap(path: Path) -> bool:
    """Whether a folder holds a model of COLMAP, or one below it where COLMAP puts it."""
    return path.is_dir() and model_folder(path) is not None


def open_colmap(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of the model's images in order of their ids, without depth.

    Raises RecordingError, UsageError where nobody has said how many metres a unit is.
    """
    options = options or ReadOptions()
    folder = model_folder(path) or path
    model = read_model(folder)
    contents = describe(model)
    if not model.images:
        raise RecordingError(f"{folder}: the model has no images; it holds {contents}")
    root = _image_root(path, folder, model)
    if root is None:
        raise RecordingError(
            f"{path}: none of its images is there, {next(iter(model.images.values())).name!r} for one (looked in "
            f"images/ beside the model and in the folder itself); it holds {contents}: no map without images"
        )
    scale = _scale(folder, options, path)
    notes: list[str] = []
    found: dict[Lens, tuple[Camera, Straightener | None]] = {}
    for lens in dict.fromkeys(model.lenses.values()):
        own, straight, note = as_camera(lens)
        found[lens] = own, straight
        if note and note not in notes:
            notes.append(note)
    entries, dropped = [], []
    straighteners: dict[int, Straightener] = {}
    for image in sorted(model.images.values(), key=lambda item: item.image_id):
        if image.camera_id not in model.lenses:
            dropped.append(DroppedFrame(image.name, f"its camera {image.camera_id} is not in the model"))
            continue
        pose = invert_pose(image.camera_from_world)
        pose[:3, 3] *= scale
        own, straight = found[model.lenses[image.camera_id]]
        if straight is not None:
            straighteners[image.image_id] = straight
        entries.append(FrameEntry(image.image_id, image.name, None, root / image.name, None, None, pose, camera=own))
    notes.append("COLMAP's model has no depth: `semdb refine` triangulates the points of keypoints")
    if options.up is None and not is_metric(folder):
        notes.append("nothing says which way is up: the axes are the model's; --up x,y,z or --up cameras makes z of it")
    draft = Draft(
        path=path,
        name=path.resolve().name,
        format="colmap",
        total_frames=len(model.images),
        entries=entries,
        dropped=dropped,
        notes=notes,
        contents=(contents,),
    )
    if straighteners:
        draft.data = _StraightData(straighteners)
        draft.known_camera = entries[0].camera if entries else None
    return finish(draft, camera)


def describe(model: ColmapModel) -> str:
    """What a model holds, for people."""
    seen = sum(image.points for image in model.images.values())
    error = f", mean reprojection error {model.mean_error:.3f} px" if np.isfinite(model.mean_error) else ""
    return (
        f"{len(model.images)} images of {len(model.lenses)} cameras, {model.points} points, {seen} observations{error}"
    )


class _StraightData:
    """Images of which some are made straight."""

    def __init__(self, straighteners: dict[int, Straightener]) -> None:
        self._straighteners = straighteners

    def color(self, entry: FrameEntry) -> RawColor:
        file = read_bytes(entry.image_path)
        straight = self._straighteners.get(entry.index)
        if straight is None:
            return RawColor(file=file)
        return RawColor(pixels=straight.color(decode_color(file, str(entry.image_path))))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        return None


def is_metric(folder: Path) -> bool:
    """Whether semdb wrote the model, of a map of its own."""
    text = folder / "cameras.txt"
    return not (folder / "cameras.bin").is_file() and text.is_file() and METRIC in read_text(text, escape=True)[:4096]


def _scale(folder: Path, options: ReadOptions, path: Path) -> float:
    if options.scale is not None:
        return options.scale
    if is_metric(folder):
        return 1.0
    raise UsageError(
        f"{path}: a model of COLMAP has no scale: give --scale N, the metres of one unit (1 where it was made metric), "
        "and --up x,y,z (or cameras), since it has no up either"
    )


def _image_root(path: Path, folder: Path, model: ColmapModel) -> Path | None:
    """The folder that has the images; None where there is none."""
    names = [image.name for image in model.images.values()][:20]
    around = [
        path / "images",
        folder / "images",
        folder.parent / "images",
        folder.parent.parent / "images",
        path,
        folder,
    ]
    return next((root for root in around if any((root / name).is_file() for name in names)), None)


LAYOUT = Layout(
    "colmap",
    "COLMAP (cameras, images and points3D, .txt or .bin, with images/)",
    is_colmap,
    lambda path, camera, options: [open_colmap(path, camera, options)],
    frozenset({"scale"}),
)
