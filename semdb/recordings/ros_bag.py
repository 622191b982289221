"""ROS 1 and ROS 2 bags: ``.bag``, ``.db3``, ``.mcap``, or the folder of one, read where they lie and without ROS.

Times are those of headers. Poses come from ``/tf`` and ``/tf_static``, else Odometry, PoseStamped or Path. Depth with a
camera of its own is registered to colour by the transform between the two.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import FrameError, RecordingError
from semdb.geometry import pose_from, rotation_from_quat_wxyz
from semdb.recordings.assembly import Draft, finish, unknown_camera
from semdb.recordings.association import MAX_TIME_DIFFERENCE_NS, nearest_pairs
from semdb.recordings.base import DroppedFrame, FrameEntry, Layout, RawColor, RawDepth, Recording
from semdb.recordings.cameras import with_size
from semdb.recordings.images import decode_color, scaled_depth
from semdb.recordings.lens import Lens, Straightener, as_camera
from semdb.recordings.options import ReadOptions
from semdb.recordings.own_depth import SCALE, DepthCamera, in_color, resized
from semdb.recordings.ros_messages import MILLIMETRES, color_of, depth_of, encoding_of, lens_of
from semdb.recordings.ros_poses import CameraPoses, read_transforms
from semdb.recordings.ros_reader import Bag, Place, is_bag
from semdb.recordings.ros_topics import REGISTERED, Chosen, choose_topics
from semdb.types import Camera, FloatArray

RECORDERS = re.compile(r"^/device_\d+/(.*/option/|.*/metadata$|(.*/)?info$)")
LIMIT_MS = MAX_TIME_DIFFERENCE_NS / 1e6


@dataclass(slots=True)
class _Stream:
    """The images of a topic: where they lie, their times, and how long the longest pause is."""

    topic: str
    places: list[Place] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    frame_id: str = ""

    def sort(self) -> None:
        order = np.argsort(np.array(self.stamps, dtype=np.int64), kind="stable")
        self.places = [self.places[i] for i in order]
        self.stamps = [self.stamps[i] for i in order]

    def about(self) -> str:
        """Rate and longest pause, for people."""
        steps = np.diff(np.array(self.stamps, dtype=np.int64)) * 1e-9
        if not len(steps) or steps.sum() <= 0:
            return f"{len(self.stamps)} image(s)"
        return f"{len(steps) / steps.sum():.1f} Hz, longest pause {steps.max() * 1000:.0f} ms"


def open_ros_bag(path: Path, camera: Camera | None = None, options: ReadOptions | None = None) -> Recording:
    """A recording of the colour images of a bag. Raises RecordingError, UsageError without the ros extra."""
    options = options or ReadOptions()
    bag = Bag(path)
    chosen = choose_topics(bag, options)
    notes = list(chosen.notes)
    streams = _index(bag, [topic for topic in (chosen.color, chosen.depth) if topic is not None])
    color, depth = streams[chosen.color], streams.get(chosen.depth or "")
    transforms = read_transforms(bag, color.frame_id, notes)
    lens = None if camera is not None else _lens(bag, chosen.color_info, chosen.color)
    size, encoding = _first_image(bag, color)
    if camera is not None:
        known, straight, note = with_size(camera, size), None, None
    elif lens is None:
        raise unknown_camera(path)
    else:
        known, straight, note = as_camera(lens)
    if (known.width, known.height) != size and camera is None:
        raise RecordingError(
            f"{path}: {chosen.color_info} is of {known.width}x{known.height} pixels, but {chosen.color} has "
            f"{size[0]}x{size[1]}; give --info-topic or --camera"
        )
    if note:
        notes.append(f"{chosen.color_info}: {note}")
    own, scale = _depth_source(
        bag, chosen, depth, known if lens is None else None, lens, color.frame_id, transforms, notes, options
    )
    poses = CameraPoses(transforms, color.frame_id, options, notes)
    draft = Draft(
        path=path,
        name=path.resolve().name.removesuffix(path.suffix) if path.is_file() else path.resolve().name,
        format="ros_bag",
        total_frames=len(color.places),
        entries=[],
        dropped=[],
        notes=notes,
        known_camera=known,
        depth_scale=scale,
    )
    partner = _associate(draft, color, depth, poses, options)
    draft.data = _BagData(
        bag, color.places, partner, depth, own, known, straight, options.depth_scale or _units(bag, chosen)
    )
    draft.contents = _contents(bag, chosen, streams, encoding, poses)
    return finish(draft, camera)


def _index(bag: Bag, topics: list[str]) -> dict[str, _Stream]:
    """Places and times of all images of `topics`; one pass over the bag, nothing is decoded."""
    streams = {topic: _Stream(topic) for topic in topics}
    for message in bag.messages(topics):
        stream = streams[message.place.topic]
        stream.places.append(message.place)
        stream.stamps.append(message.stamp_ns)
        stream.frame_id = stream.frame_id or message.frame_id
    for stream in streams.values():
        stream.sort()
    return streams


def _lens(bag: Bag, topic: str | None, images: str) -> Lens | None:
    """The lens of the first camera_info of a topic; None without a topic. Raises RecordingError."""
    if topic is None:
        return None
    for message in bag.messages([topic]):
        try:
            return lens_of(bag.decode(message), rectified="rect" in images)
        except (ValueError, AttributeError, TypeError) as error:
            raise RecordingError(f"{bag.path}: {topic} {error}") from error
    return None


def _first_image(bag: Bag, stream: _Stream) -> tuple[tuple[int, int], str]:
    """Size (width, height) and encoding of the first image that can be decoded. Raises RecordingError."""
    reason = "there is none"
    for place in stream.places[:5]:
        try:
            message = bag.read(place)
            raw = color_of(message, f"{bag.path}: {stream.topic}")
            pixels = (
                raw.pixels if raw.pixels is not None else decode_color(raw.file or b"", f"{bag.path}: {stream.topic}")
            )
        except FrameError as error:
            reason = str(error)
            continue
        return (pixels.shape[1], pixels.shape[0]), encoding_of(message)
    raise RecordingError(f"{bag.path}: no image of {stream.topic} can be decoded: {reason}")


def _units(bag: Bag, chosen: Chosen) -> float:
    """Units a metre of whole numbers: millimetres, or what RealSense's recorder says of the depth sensor."""
    sensor = (chosen.depth or "").rsplit("/", 3)[0]
    name = f"{sensor}/option/Depth Units/value"
    if chosen.depth and any(topic.name == name for topic in bag.topics):
        for message in bag.messages([name]):
            value = float(bag.decode(message).data)
            if np.isfinite(value) and value > 0:
                return float(round(1.0 / value, 3))
    return MILLIMETRES


def _depth_source(
    bag: Bag,
    chosen: Chosen,
    depth: _Stream | None,
    camera: Camera | None,
    lens: Lens | None,
    color_frame: str,
    transforms: Any,
    notes: list[str],
    options: ReadOptions,
) -> tuple[DepthCamera | None, float]:
    """The camera of depth where it is not that of colour, and the scale of what is stored."""
    scale = options.depth_scale or _units(bag, chosen)
    if depth is None or chosen.depth is None:
        notes.append("no topic of depth images: the frames have no depth")
        return None, scale
    own = _lens(bag, chosen.depth_info, chosen.depth)
    same_frame = depth.frame_id == color_frame or REGISTERED.search(chosen.depth) is not None
    recorder = chosen.depth.endswith("/image/data")
    if own is None:
        notes.append(f"no camera_info of {chosen.depth}: depth is taken as registered to colour")
        return None, scale
    if same_frame and not recorder and (lens is None or own == lens):
        return None, scale
    pose = np.eye(4)
    if recorder:
        pose = _recorder_extrinsics(bag, chosen)
    elif not same_frame:
        found, reason = transforms.pose(color_frame, depth.frame_id, depth.stamps[0])
        if found is None:
            notes.append(f"depth has a camera of its own, but {reason}: it is taken to be where colour is")
        else:
            pose = found
    plain, _, note = as_camera(own)
    if note:
        notes.append(f"{chosen.depth_info}: {note}")
    notes.append(
        f"depth has a camera of its own ({plain.width}x{plain.height}, {np.linalg.norm(pose[:3, 3]) * 1000:.1f} mm "
        "beside colour): registered to colour"
    )
    return DepthCamera(plain, pose), SCALE


def _recorder_extrinsics(bag: Bag, chosen: Chosen) -> FloatArray:
    """color_from_depth of RealSense's recorder: each stream has its pose from the reference stream in ``tf/0``."""
    poses = []
    for topic in (chosen.color, chosen.depth or ""):
        name = f"{topic.removesuffix('/image/data')}/tf/0"
        pose = np.eye(4)
        if any(found.name == name for found in bag.topics):
            for message in bag.messages([name]):
                value = bag.decode(message)
                q, t = value.rotation, value.translation
                pose = pose_from(rotation_from_quat_wxyz([q.w, q.x, q.y, q.z]), [t.x, t.y, t.z])
                break
        poses.append(pose)
    return np.asarray(poses[0] @ np.linalg.inv(poses[1]))


def _associate(
    draft: Draft, color: _Stream, depth: _Stream | None, poses: CameraPoses, options: ReadOptions
) -> list[int | None]:
    """Fills `draft` with the frames that have all that the bag has. Returns for each colour image that of depth."""
    times = np.array(color.stamps, dtype=np.int64)
    partner: list[int | None] = [None] * len(times)
    gaps = np.zeros(len(times), dtype=np.int64)
    if depth is not None and depth.stamps:
        shift = round(options.depth_offset_ms * 1e6)
        partner, gaps = nearest_pairs(times, np.array(depth.stamps, dtype=np.int64) + shift)
        if all(found is None for found in partner):
            nearest = int(times[np.argmin(gaps)])
            late = min((nearest - stamp - shift for stamp in depth.stamps), key=abs) + shift
            draft.notes.append(
                f"no depth image lies within {LIMIT_MS:g} ms of a colour image (the nearest: {gaps.min() / 1e6:.1f} ms)"
                f": the frames have no depth (--depth-offset-ms {late / 1e6:.1f} where the clocks differ by that)"
            )
            depth = None
    for index, time_ns in enumerate(color.stamps):
        name = f"{color.topic} #{index}"
        if index and time_ns == color.stamps[index - 1]:
            draft.dropped.append(DroppedFrame(name, "same time as the image before"))
            continue
        if depth is not None and partner[index] is None:
            gap = int(gaps[index]) / 1e6
            draft.dropped.append(
                DroppedFrame(name, f"no depth image within {LIMIT_MS:g} ms (the nearest: {gap:.1f} ms)")
            )
            continue
        pose, reason = poses.at(time_ns)
        if poses.known and pose is None:
            draft.dropped.append(DroppedFrame(name, reason))
            continue
        draft.entries.append(FrameEntry(index, name, time_ns, draft.path, draft.path if depth else None, None, pose))
    return partner


def _contents(
    bag: Bag, chosen: Chosen, streams: dict[str, _Stream], encoding: str, poses: CameraPoses
) -> tuple[str, ...]:
    """A line for each topic: type, messages, rate, and what it is taken for."""
    taken: dict[str | None, str] = {
        chosen.color: f"colour ({encoding})",
        chosen.depth: "depth",
        chosen.color_info: "camera",
    }
    taken |= {chosen.depth_info: "camera of depth"} if chosen.depth_info != chosen.color_info else {}
    taken |= dict.fromkeys(poses.topics, "poses")
    lines = []
    quiet = [topic for topic in bag.topics if topic.name not in taken and RECORDERS.search(topic.name)]
    for topic in bag.topics:
        if topic in quiet:
            continue
        rate = f", {topic.messages / bag.duration_s:.1f} Hz" if bag.duration_s > 0 and topic.messages > 1 else ""
        about = f", {streams[topic.name].about()}" if topic.name in streams else rate
        use = f": {taken[topic.name]}" if topic.name in taken else ""
        lines.append(f"{topic.name} ({topic.kind.replace('/msg/', '/')}, {topic.messages}{about}){use}")
    if quiet:
        lines.append(f"{len(quiet)} topics of RealSense's recorder: options and metadata")
    return tuple(lines)


class _BagData:
    """Images of a bag."""

    def __init__(
        self,
        bag: Bag,
        color: list[Place],
        partner: list[int | None],
        depth: _Stream | None,
        own: DepthCamera | None,
        camera: Camera,
        straight: Straightener | None,
        scale: float,
    ) -> None:
        self._bag, self._color, self._partner, self._own = bag, color, partner, own
        self._depth = [] if depth is None else depth.places
        self._camera, self._straight, self._scale = camera, straight, scale

    def color(self, entry: FrameEntry) -> RawColor:
        name = f"{self._bag.path}: {entry.name}"
        raw = color_of(self._bag.read(self._color[entry.index]), name)
        if self._straight is None:
            return raw
        pixels = decode_color(raw.file or b"", name) if raw.pixels is None else raw.pixels
        return RawColor(pixels=self._straight.color(pixels))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        match = self._partner[entry.index]
        if match is None:
            return None
        raw = depth_of(self._bag.read(self._depth[match]), f"{self._bag.path}: depth of {entry.name}", self._scale)
        height, width = raw.values.shape
        metres = scaled_depth(raw.values, raw.scale)
        if self._own is not None:
            own = self._own.camera
            camera = own if (own.width, own.height) == (width, height) else resized(own, width, height)
            return in_color(metres, DepthCamera(camera, self._own.color_from_depth), self._camera)
        if (width, height) != (self._camera.width, self._camera.height):
            return in_color(metres, DepthCamera(resized(self._camera, width, height), np.eye(4)), self._camera)
        if self._straight is not None:
            return RawDepth(self._straight.depth(raw.values), raw.scale)
        return raw


LAYOUT = Layout(
    "ros_bag",
    "ROS bags (.bag, .db3, .mcap, or the folder of one)",
    is_bag,
    lambda path, camera, options: [open_ros_bag(path, camera, options)],
    frozenset(
        {
            "depth_scale",
            "poses_are",
            "axes",
            "scale",
            "time_offset_ms",
            "depth_offset_ms",
            "color_topic",
            "depth_topic",
            "info_topic",
            "world_frame",
        }
    ),
)
