"""Keyframes as a bag of ROS 2 in MCAP: compressed images, camera_info, depth and /tf, for Foxglove and ROS 2."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from semdb.database.records import KeyframeHead, StoredImage
from semdb.errors import UsageError
from semdb.exchange.source import ExportOptions, MapSource, decoded, new_file
from semdb.geometry import quat_wxyz_from_rotation
from semdb.recordings.images import encode_16bit
from semdb.recordings.ros_messages import COMPRESSED_HEADER

WORLD, CAMERA = "map", "camera_color_optical_frame"
UNTIMED_STEP_NS = 100_000_000  # between keyframes that have no time
MILLIMETRES = 1000.0


def write_mcap(source: MapSource, out: Path, options: ExportOptions) -> str:
    """One message of each topic for each keyframe, at its time. Raises UsageError without the ros extra."""
    try:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise UsageError("the format mcap needs the ros extra: pip install 'semdb[ros]'") from error
    new_file(out)
    store = get_typestore(Stores.ROS2_HUMBLE)
    make = _Messages(store)
    with tempfile.TemporaryDirectory(prefix=".semdb-mcap-", dir=out.parent) as temporary:
        folder = Path(temporary) / "bag"
        with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
            topics: dict[str, Any] = {}
            for number, head in enumerate(source.heads):
                stamp = number * UNTIMED_STEP_NS if head.timestamp_ns is None else max(0, head.timestamp_ns)
                for topic, message in make.keyframe(head, source.image(head.id), stamp):
                    kind = message.__msgtype__
                    if topic not in topics:
                        topics[topic] = writer.add_connection(topic, kind, typestore=store)
                    writer.write(topics[topic], stamp, store.serialize_cdr(message, kind))
                source.tell("exporting", number + 1)
        [file] = folder.glob("*.mcap")
        shutil.move(file, out)
    return f"{len(source.heads)} keyframes on {', '.join(topics)}"


class _Messages:
    """Makes messages of ROS 2."""

    def __init__(self, store: Any) -> None:
        self._types = store.types

    def _make(self, name: str, **values: Any) -> Any:
        return self._types[name](**values)

    def keyframe(self, head: KeyframeHead, stored: StoredImage, stamp: int) -> list[tuple[str, Any]]:
        """Topics and messages of a keyframe."""
        time = self._make("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = self._make("std_msgs/msg/Header", stamp=time, frame_id=CAMERA)
        data = np.frombuffer(stored.rgb, np.uint8)
        image = self._make("sensor_msgs/msg/CompressedImage", header=header, format=stored.rgb_format, data=data)
        found = [
            ("/tf", self._transform(head, time)),
            ("/camera/color/camera_info", self._info(head, header)),
            ("/camera/color/image/compressed", image),
        ]
        depth = decoded(stored, head)[1] if stored.depth is not None else None
        if depth is not None:
            units = np.rint(np.nan_to_num(depth) * MILLIMETRES)
            png = encode_16bit(np.where(units < 65535, units, 0).astype(np.uint16))
            body = np.frombuffer(COMPRESSED_HEADER.pack(0, 0.0, 0.0) + png, np.uint8)
            message = self._make(
                "sensor_msgs/msg/CompressedImage", header=header, format="16UC1; compressedDepth png", data=body
            )
            found.append(("/camera/aligned_depth_to_color/image/compressedDepth", message))
            found.append(("/camera/aligned_depth_to_color/camera_info", self._info(head, header)))
        return found

    def _transform(self, head: KeyframeHead, time: Any) -> Any:
        w, x, y, z = (float(value) for value in quat_wxyz_from_rotation(head.world_from_camera[:3, :3]))
        tx, ty, tz = (float(value) for value in head.world_from_camera[:3, 3])
        transform = self._make(
            "geometry_msgs/msg/Transform",
            translation=self._make("geometry_msgs/msg/Vector3", x=tx, y=ty, z=tz),
            rotation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        header = self._make("std_msgs/msg/Header", stamp=time, frame_id=WORLD)
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=CAMERA, transform=transform
        )
        return self._make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def _info(self, head: KeyframeHead, header: Any) -> Any:
        camera = head.camera
        distortion = (*camera.distortion, *([0.0] * 5))[:5]
        roi = self._make(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=camera.height,
            width=camera.width,
            distortion_model="plumb_bob",
            d=np.array(distortion, dtype=np.float64),
            k=camera.matrix.ravel(),
            r=np.eye(3).ravel(),
            p=np.column_stack([camera.matrix, np.zeros(3)]).ravel(),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )
