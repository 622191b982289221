"""Files of ROS 1 and 2 through `rosbags`: topics, messages in order, and single messages again. No ROS is needed.

`rosbags` is not made for broken files: whatever it raises on one becomes an error that says what can still be read.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.files import UnusableFileError, check_place

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, TF = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
ODOMETRY, POSE, PATH = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Path"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
OLD_TF = "tf/msg/tfMessage"
SUFFIXES = (".bag", ".db3", ".mcap")
_ROS1_HEADER = struct.Struct("<III")  # seq, sec, nsec
_ROS2_HEADER = struct.Struct("<iI")  # sec, nanosec, after the four bytes that say how it is encoded


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic, its type as ROS 2 writes it, and how many messages it has."""

    name: str
    kind: str
    messages: int


@dataclass(frozen=True, slots=True)
class Place:
    """Where a message lies: its topic, the bag's time of it, and which one of that time it is."""

    topic: str
    bag_ns: int
    ordinal: int


@dataclass(frozen=True, slots=True)
class Message:
    """A message that is not decoded. `stamp_ns` and `frame_id` are of its header."""

    place: Place
    stamp_ns: int
    frame_id: str
    data: bytes


class Bag:
    """An open bag. Several threads may ask it for messages."""

    def __init__(self, path: Path) -> None:
        """Raises UsageError without rosbags, RecordingError for a file that cannot be read."""
        self.path = path
        self._lock = threading.Lock()
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError as error:
            raise UsageError(f"{path}: bags need the ros extra: pip install 'semdb[ros]'") from error
        for file in [path, *path.iterdir()] if path.is_dir() else [path]:
            try:
                check_place(file)
            except UnusableFileError as error:
                raise RecordingError(error.at(file)) from error
        try:
            files = _files(path)
            self._reader: Any = AnyReader(files, default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        except Exception as error:  # rosbags lets many kinds through
            raise self.broken(error) from error
        self.ros2 = bool(self._reader.is2)
        self._connections: dict[str, list[Any]] = {}
        for connection in self._reader.connections:
            self._connections.setdefault(connection.topic, []).append(connection)
        self.topics = tuple(
            Topic(name, str(found[0].msgtype), sum(connection.msgcount for connection in found))
            for name, found in sorted(self._connections.items())
        )

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last message."""
        try:
            return max(0.0, float(self._reader.duration) * 1e-9)
        except Exception:  # of a bag without messages
            return 0.0

    def messages(self, topics: Sequence[str]) -> Iterator[Message]:
        """All messages of `topics` in the order of the bag. Raises RecordingError where the file is damaged."""
        wanted = [connection for name in topics for connection in self._connections[name]]
        counts: dict[tuple[str, int], int] = {}
        if not wanted:
            return
        try:
            for connection, time_ns, data in self._reader.messages(wanted):
                key = connection.topic, time_ns
                ordinal = counts.get(key, 0)
                counts[key] = ordinal + 1
                stamp_ns, frame_id = self._header(data, time_ns)
                yield Message(Place(connection.topic, time_ns, ordinal), stamp_ns, frame_id, data)
        except (RecordingError, GeneratorExit):
            raise
        except Exception as error:
            raise self.broken(error) from error

    def read(self, place: Place) -> Any:
        """The decoded message at `place`. Raises FrameError."""
        try:
            with self._lock:
                found = self._reader.messages(self._connections[place.topic], place.bag_ns, place.bag_ns + 1)
                for ordinal, (connection, _, data) in enumerate(found):
                    if ordinal == place.ordinal:
                        return self._reader.deserialize(data, connection.msgtype)
        except Exception as error:
            raise FrameError(f"{self.path}: {place.topic} at {place.bag_ns}: cannot be read: {error}") from error
        raise FrameError(f"{self.path}: {place.topic} at {place.bag_ns}: the message is not there any more")

    def decode(self, message: Message) -> Any:
        """The content of a message. Raises RecordingError."""
        try:
            with self._lock:
                return self._reader.deserialize(message.data, self._connections[message.place.topic][0].msgtype)
        except Exception as error:
            raise self.broken(error) from error

    def broken(self, error: Exception) -> RecordingError:
        """One error for a file that `rosbags` cannot read: why, and what can still be read."""
        from semdb.recordings.ros_broken import what_is_left

        reason = " ".join(str(error).split())[:300].rstrip(".") or type(error).__name__
        return RecordingError(f"{self.path}: cannot be read as a bag: {reason}. {what_is_left(self.path)}")

    def _header(self, data: bytes, time_ns: int) -> tuple[int, str]:
        """Stamp and frame of a message that begins with a header; the bag's time where there is none."""
        try:
            if self.ros2:
                seconds, nanoseconds = _ROS2_HEADER.unpack_from(data, 4)
                (length,) = struct.unpack_from("<I", data, 12)
                text = data[16 : 16 + max(0, length - 1)]
            else:
                _, seconds, nanoseconds = _ROS1_HEADER.unpack_from(data)
                (length,) = struct.unpack_from("<I", data, 12)
                text = data[16 : 16 + length]
        except struct.error:
            return time_ns, ""
        stamp = seconds * 1_000_000_000 + nanoseconds
        return (stamp or time_ns), text[:256].decode(errors="replace").lstrip("/")


def is_bag(path: Path) -> bool:
    """Whether a path is a file of a bag, or a folder of ROS 2 with one."""
    if path.is_dir():
        return ((path / "metadata.yaml").is_file() and any(path.glob("*.db3*"))) or any(path.glob("*.mcap*"))
    return path.suffix.lower() in SUFFIXES and path.is_file()


def _files(path: Path) -> list[Path]:
    if path.is_dir() and not (path / "metadata.yaml").is_file():
        return sorted(file for file in path.iterdir() if file.suffix.lower() in (".mcap",))
    return [path]
