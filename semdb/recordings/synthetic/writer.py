"""Writes a synthetic recording to disk in the TUM RGB-D layout, with camera and instance masks."""

from __future__ import annotations

import copy
import json
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import UsageError
from semdb.geometry import quat_wxyz_from_rotation
from semdb.recordings.synthetic import sensor
from semdb.recordings.synthetic.mistakes import make_mistakes, with_misnamed
from semdb.recordings.synthetic.options import BETWEEN_ROOMS_M, DEPTH_SCALE, FRAME_RATE_HZ, SyntheticOptions
from semdb.recordings.synthetic.person import CATEGORY as PERSON
from semdb.recordings.synthetic.person import walker_for
from semdb.recordings.synthetic.render import Lamp, bake_light, render_view, soften_light
from semdb.recordings.synthetic.room import Room, build_room
from semdb.recordings.synthetic.scene import PackedScene, bare, mirrored, pack, plain, yaw_pose
from semdb.recordings.synthetic.trajectory import walk
from semdb.recordings.synthetic.visit import move_objects, take_away
from semdb.types import Float32Array, FloatArray, ImageArray

_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 3]


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticFrame:
    """One frame before it is written: uint8 RGB, depth in metres (0 for none), labels, world_from_camera."""

    rgb: ImageArray  # [H, W, 3]
    depth: Float32Array  # [H, W]
    labels: npt.NDArray[np.uint16]  # [H, W]
    world_from_camera: FloatArray  # [4, 4]

    @property
    def known_depth(self) -> Float32Array:
        """Depth ``[H, W]`` float32 in metres, NaN for none: as recordings give it."""
        return np.where(self.depth > 0, self.depth, np.nan).astype(np.float32)


_first_visit = lru_cache(maxsize=2)(build_room)


@lru_cache(maxsize=2)
def _scene(
    room_seed: int,
    furniture_seed: int | None,
    desks: int,
    alike: bool,
    is_plain: bool,
    is_bare: bool,
    visit_seed: int | None,
    share_taken: float,
) -> tuple[Room, PackedScene, tuple[int, ...], tuple[int, ...]]:
    """The lit room of a first (`visit_seed` None) or second visit, and the labels of what was moved and taken away."""
    room, moved, taken = _first_visit(room_seed, furniture_seed, desks), list[int](), list[int]()
    if visit_seed is not None:
        room = copy.deepcopy(room)
        moved = move_objects(room, visit_seed, room_seed)
        taken = take_away(room, share_taken, visit_seed, room_seed)
    items = mirrored(room.items) if alike else room.items
    if is_bare:
        items = bare(items)
    elif is_plain:
        items = plain(items)
    kept = tuple(label for label in moved if label not in taken)
    lit = bake_light(pack(items), _lamps(room))
    return room, soften_light(lit) if is_bare else lit, kept, tuple(taken)


def _lamps(room: Room) -> list[Lamp]:
    """The lamp under the ceiling and the windows."""
    down = np.eye(4)
    down[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]  # its y axis points down
    lamps = [Lamp(yaw_pose(0, 0, room.size[2] - 0.07) @ down, 1.2, 0.35, (2.3, 2.1, 1.8), (4, 1))]
    for pose, width, height in room.windows:
        lamps.append(Lamp(pose, width, height, (1.7, 1.9, 2.2), (2, 2)))
    return lamps


class SyntheticSequence:
    """The frames of a synthetic recording, rendered when asked for. Thread-safe: frames do not depend on each other."""

    def __init__(self, options: SyntheticOptions) -> None:
        self.options = options
        self.camera = options.camera
        visit = options.seed if options.second_visit else None
        self.room, self._packed, self.moved, self.taken = _scene(
            *(options.room_seed, options.furniture_seed, options.desks, options.alike, options.plain, options.bare),
            *(visit, options.taken),
        )
        self._walker = walker_for(self.room, options.seed) if options.person else None
        # one more pose than frames: the blur of the last frame needs where the camera goes next
        poses = walk(
            self.room, options.frames + 1, options.lap_frames, options.seed, options.second_visit,
            options.eye_height, options.backwards,
        )  # fmt: skip
        self._poses = poses
        self.poses: FloatArray = poses[:-1].copy()
        self.poses[:, 0, 3] += BETWEEN_ROOMS_M * options.place

    @property
    def classes(self) -> dict[int, str]:
        """COCO-style class name of each label."""
        classes = self._true_classes()
        return with_misnamed(classes) if self.options.confused > 0 else classes

    def _true_classes(self) -> dict[int, str]:
        return self.room.classes() | ({} if self._walker is None else {self._walker.label: PERSON})

    def timestamp(self, index: int) -> float:
        """Seconds."""
        return 1.0 + index / FRAME_RATE_HZ

    def render(self, index: int) -> SyntheticFrame:
        """Frame `index` with all effects of the options."""
        options, pose = self.options, self._poses[index]
        view = render_view(self._packed, self.camera, pose)
        if self._walker is not None:
            view = self._walker.add_to(view, self.camera, pose, index)
        rgb, depth = view.rgb, view.depth
        if options.lighting > 0:
            rgb = sensor.change_light(rgb, depth, self.camera, pose, options.lighting, options.seed, index)
        if options.blur > 0:
            rgb = sensor.motion_blur(rgb, depth, self.camera, pose, self._poses[index + 1], options.blur)
        if options.noise:
            rng = np.random.default_rng([options.seed, 5, index])
            rgb, depth = sensor.noisy_image(rgb, rng), sensor.noisy_depth(depth, self.camera, rng)
        labels = view.labels
        if options.missed > 0 or options.confused > 0:
            labels = make_mistakes(labels, self._true_classes(), options.missed, options.confused, options.seed, index)
        return SyntheticFrame(rgb, depth, labels, self.poses[index])


def write_synthetic_recording(
    directory: Path, options: SyntheticOptions, progress: Callable[[int, int], None] | None = None
) -> None:
    """Renders a recording into `directory`, which must be empty or absent (UsageError otherwise).

    All or nothing: frames are written to a folder beside it, which then takes its name; `progress` gets frames done
    and frames in all. The layout is described in docs/synthetic.md.
    """
    directory = Path(directory)
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise UsageError(f"{directory}: is not empty; give a new or empty folder for the synthetic recording")
    target = directory.resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        write_frames(work, SyntheticSequence(options), progress)
        work.chmod(0o755)
        work.replace(target)  # an empty folder gives way, a full one does not
    finally:
        shutil.rmtree(work, ignore_errors=True)


def write_synthetic_building(
    directory: Path, options: SyntheticOptions, rooms: int, progress: Callable[[int, int], None] | None = None
) -> list[Path]:
    """Renders `rooms` rooms of different furniture into folders ``room-000``, ... of `directory`, in one world.

    Their seeds go up from those of `options`. Raises UsageError for a directory that is not empty.
    """
    directory = Path(directory)
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise UsageError(f"{directory}: is not empty; give a new or empty folder for the synthetic recordings")
    folders = []
    for room, room_options in enumerate(building(options, rooms)):

        def show(done: int, total: int, before: int = room * options.frames) -> None:
            if progress is not None:
                progress(before + done, rooms * total)

        folders.append(directory / f"room-{room:03d}")
        write_synthetic_recording(folders[-1], room_options, show)
    return folders


def building(options: SyntheticOptions, rooms: int) -> list[SyntheticOptions]:
    """The options of each of the rooms of a building. Raises UsageError for less than one."""
    if rooms < 1:
        raise UsageError(f"a building has at least one room, not {rooms}")
    return [replace(options, room_seed=options.room_seed + k, seed=options.seed + k, place=k) for k in range(rooms)]


def write_frames(folder: Path, sequence: SyntheticSequence, progress: Callable[[int, int], None] | None) -> None:
    options, camera = sequence.options, sequence.camera
    for name in ("rgb", "depth", "masks"):
        (folder / name).mkdir()
    stems = [f"{sequence.timestamp(i):.6f}" for i in range(options.frames)]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with ThreadPoolExecutor(min(cores, 8)) as pool:
        jobs = [pool.submit(_write_frame, folder, stems[i], sequence, i) for i in range(options.frames)]
        try:
            for done, job in enumerate(as_completed(jobs), 1):
                job.result()
                if progress is not None:
                    progress(done, options.frames)
        except BaseException:
            pool.shutdown(wait=True, cancel_futures=True)
            raise
    for name in ("rgb", "depth"):
        rows = [f"{stem} {name}/{stem}.png" for stem in stems]
        (folder / f"{name}.txt").write_text("\n".join(["# synthetic recording", "# timestamp filename", *rows, ""]))
    rows = ["# synthetic recording", "# timestamp tx ty tz qx qy qz qw"]
    for stem, pose in zip(stems, sequence.poses, strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3])
        rows.append(" ".join([stem, *(repr(float(v)) for v in (*pose[:3, 3], x, y, z, w))]))
    (folder / "groundtruth.txt").write_text("\n".join([*rows, ""]))
    lens: dict[str, float | list[float]] = {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
    }
    lens |= {"cy": camera.cy, "distortion": [], "depth_scale": int(DEPTH_SCALE)}
    (folder / "camera.json").write_text(json.dumps(lens, indent=2) + "\n")
    classes = {str(label): name for label, name in sorted(sequence.classes.items())}
    (folder / "masks" / "classes.json").write_text(json.dumps(classes, indent=0) + "\n")


def _write_frame(folder: Path, stem: str, sequence: SyntheticSequence, index: int) -> None:
    frame = sequence.render(index)
    units = np.clip(np.rint(frame.depth.astype(np.float64) * DEPTH_SCALE), 0, 65535).astype(np.uint16)
    images = (("rgb", np.ascontiguousarray(frame.rgb[..., ::-1])), ("depth", units), ("masks", frame.labels))
    for name, image in images:
        path = folder / name / f"{stem}.png"
        if not cv2.imwrite(str(path), image, _PNG):
            raise OSError(f"{path}: cannot be written")
