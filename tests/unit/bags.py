"""Tiny bags of ROS 1 and ROS 2 with the room of `recording_miniatures`, written by rosbags."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from semdb.geometry import invert_pose, quat_wxyz_from_rotation
from semdb.recordings.rvl import encode_rvl
from semdb.types import Camera, FloatArray
from tests.unit.recording_miniatures import SMALL, depth_units, pose, render

OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # body_from_optical
FIRST_S = 1000
STEP_NS = 100_000_000
COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
KINDS = ("bag", "db3", "mcap")


@dataclass
class Plan:
    """What is written. The bag's own time of messages is seconds after that of their headers."""

    kind: str = "mcap"
    frames: int = 4
    camera: Camera = SMALL
    color: str = "rgb8"
    depth: str = "16UC1"
    poses: str = "tf"  # tf, odometry, pose, path or none
    depth_camera: Camera | None = None
    color_from_depth: FloatArray = field(default_factory=lambda: np.eye(4))
    distortion_model: str = "plumb_bob"
    coefficients: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_delay_ms: int = 3
    infrared: bool = False
    picture: Callable[[Camera, FloatArray], Any] = render


class Messages:
    """Makes messages of either version of ROS."""

    def __init__(self, ros1: bool) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        if ros1:
            definition = "geometry_msgs/TransformStamped[] transforms\n"
            self.store.register(get_types_from_msg(definition, "tf2_msgs/msg/TFMessage"))

    def make(self, name: str, **values: Any) -> Any:
        return self.store.types[name](**values)

    def header(self, stamp_ns: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
        extra = {"seq": 0} if self.ros1 else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **extra)

    def image(self, stamp_ns: int, frame: str, encoding: str, values: np.ndarray, padding: int = 4) -> Any:
        rows = values.reshape(len(values), -1).view(np.uint8)
        padded = np.pad(rows, ((0, 0), (0, padding)))
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp_ns, frame),
            height=values.shape[0],
            width=values.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=padded.shape[1],
            data=np.ascontiguousarray(padded).ravel(),
        )

    def compressed(self, stamp_ns: int, frame: str, form: str, data: bytes) -> Any:
        header = self.header(stamp_ns, frame)
        return self.make(
            "sensor_msgs/msg/CompressedImage", header=header, format=form, data=np.frombuffer(data, np.uint8)
        )

    def info(self, stamp_ns: int, frame: str, camera: Camera, model: str, coefficients: tuple[float, ...]) -> Any:
        k = camera.matrix.ravel()
        p = np.column_stack([camera.matrix, np.zeros(3)]).ravel()
        values = {"d": np.array(coefficients), "k": k, "r": np.eye(3).ravel(), "p": p}
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(stamp_ns, frame),
            height=camera.height,
            width=camera.width,
            distortion_model=model,
            **{(key.upper() if self.ros1 else key): value for key, value in values.items()},
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def _parts(self, matrix: FloatArray) -> tuple[Any, list[float]]:
        w, x, y, z = (float(v) for v in quat_wxyz_from_rotation(matrix[:3, :3]))
        q = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        return q, [float(v) for v in matrix[:3, 3]]

    def transform(self, stamp_ns: int, parent: str, child: str, matrix: FloatArray) -> Any:
        q, (x, y, z) = self._parts(matrix)
        value = self.make(
            "geometry_msgs/msg/Transform", translation=self.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z), rotation=q
        )
        header = self.header(stamp_ns, parent)
        return self.make("geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=value)

    def tf(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def pose(self, matrix: FloatArray) -> Any:
        q, (x, y, z) = self._parts(matrix)
        point = self.make("geometry_msgs/msg/Point", x=x, y=y, z=z)
        return self.make("geometry_msgs/msg/Pose", position=point, orientation=q)

    def stamped(self, stamp_ns: int, frame: str, matrix: FloatArray) -> Any:
        return self.make("geometry_msgs/msg/PoseStamped", header=self.header(stamp_ns, frame), pose=self.pose(matrix))

    def odometry(self, stamp_ns: int, frame: str, child: str, matrix: FloatArray) -> Any:
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        nothing = np.zeros(36)
        return self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp_ns, frame),
            child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(matrix), covariance=nothing),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=nothing),
        )


def compressed_depth(z: np.ndarray, form: str) -> tuple[str, bytes]:
    """Format and data of compressedDepth: "16UC1 png", "16UC1 rvl" or "32FC1 png"."""
    encoding, codec = form.split()
    if encoding == "32FC1":
        quant_a, quant_b = 100.0, -1.0
        values = np.rint(quant_a / z + quant_b).astype(np.uint16)
        head = struct.pack("<iff", 0, quant_a, quant_b)
    else:
        values, head = depth_units(z, 1000), struct.pack("<iff", 0, 0.0, 0.0)
    if codec == "rvl":
        body = struct.pack("<II", values.shape[1], values.shape[0]) + encode_rvl(values)
    else:
        done, data = cv2.imencode(".png", values)
        assert done
        body = data.tobytes()
    return f"{encoding}; compressedDepth {codec}", head + body


def write_bag(path: Path, plan: Plan) -> Path:
    """A bag at `path` (a folder for ROS 2, whose file is returned)."""
    ros1 = plan.kind == "bag"
    make = Messages(ros1)
    rows: list[tuple[str, int, Any]] = []
    own = plan.depth_camera
    depth_frame = "camera_depth_optical_frame" if own else "camera_color_optical_frame"
    depth_topic = "/camera/depth/image_rect_raw" if own else DEPTH
    rows.append(("/tf_static", FIRST_S * 10**9, make.tf(
        make.transform(0, "base_link", "camera_link", _shift(0.1, 0.0, 0.3)),
        make.transform(0, "camera_link", "camera_color_optical_frame", OPTICAL),
        make.transform(0, "camera_color_optical_frame", "camera_depth_optical_frame", plan.color_from_depth),
    )))  # fmt: skip
    body_from_camera = _shift(0.1, 0.0, 0.3) @ OPTICAL
    for i in range(plan.frames):
        stamp = FIRST_S * 10**9 + i * STEP_NS
        rows += _color(make, plan, stamp, plan.picture(plan.camera, pose(i))[0])
        camera_pose = pose(i)
        _, z = render(own or plan.camera, camera_pose @ plan.color_from_depth if own else camera_pose)
        later = stamp + plan.depth_delay_ms * 1_000_000
        rows += _depth(make, plan, later, depth_frame, depth_topic, z)
        info = make.info(stamp, "camera_color_optical_frame", plan.camera, plan.distortion_model, plan.coefficients)
        rows.append(("/camera/color/camera_info", stamp, info))
        info = make.info(later, depth_frame, own or plan.camera, "plumb_bob", (0.0,) * 5)
        rows.append((f"{depth_topic.rsplit('/', 1)[0]}/camera_info", later, info))
        if plan.infrared:
            grey = np.zeros((8, 8), np.uint8)
            rows.append(("/camera/infra1/image_raw", stamp, make.image(stamp, "infra", "mono8", grey)))
        body = pose(i) @ invert_pose(body_from_camera)
        if plan.poses == "tf":
            odom = _shift(1.0, 2.0, 0.0)
            rows.append(("/tf", stamp, make.tf(make.transform(stamp, "map", "odom", odom))))
            rows.append(("/tf", stamp, make.tf(make.transform(stamp, "odom", "base_link", invert_pose(odom) @ body))))
        elif plan.poses == "odometry":
            rows.append(("/odom", stamp, make.odometry(stamp, "odom", "base_link", body)))
        elif plan.poses == "pose":
            rows.append(("/vrpn/pose", stamp, make.stamped(stamp, "world", body)))
    if plan.poses == "path":
        bodies = [pose(i) @ invert_pose(body_from_camera) for i in range(plan.frames)]
        poses = [make.stamped(FIRST_S * 10**9 + i * STEP_NS, "world", body) for i, body in enumerate(bodies)]
        last = FIRST_S * 10**9 + plan.frames * STEP_NS
        rows.append(("/path", last, make.make("nav_msgs/msg/Path", header=make.header(last, "world"), poses=poses)))
    return _write(path, plan, make, rows)


def _shift(x: float, y: float, z: float) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def _color(make: Messages, plan: Plan, stamp: int, image: np.ndarray) -> list[tuple[str, int, Any]]:
    frame = "camera_color_optical_frame"
    if plan.color in ("jpeg", "png"):
        done, data = cv2.imencode(f".{plan.color}", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
        assert done
        message = make.compressed(stamp, frame, f"rgb8; {plan.color} compressed bgr8", data.tobytes())
        return [(f"{COLOR}/compressed", stamp, message)]
    values = {
        "rgb8": lambda: image,
        "bgr8": lambda: image[..., ::-1],
        "bgra8": lambda: cv2.cvtColor(image, cv2.COLOR_RGB2BGRA),
        "mono8": lambda: image[..., 0],
        "bayer_rggb8": lambda: _bayer(image),
    }[plan.color]()
    return [(COLOR, stamp, make.image(stamp, frame, plan.color, np.ascontiguousarray(values)))]


def _bayer(image: np.ndarray) -> np.ndarray:
    mosaic = image[..., 1].copy()
    mosaic[::2, ::2] = image[::2, ::2, 0]
    mosaic[1::2, 1::2] = image[1::2, 1::2, 2]
    return mosaic


def _depth(make: Messages, plan: Plan, stamp: int, frame: str, topic: str, z: np.ndarray) -> list[tuple[str, int, Any]]:
    if plan.depth == "none":
        return []
    if " " in plan.depth:
        form, data = compressed_depth(z, plan.depth)
        return [(f"{topic}/compressedDepth", stamp, make.compressed(stamp, frame, form, data))]
    values = depth_units(z, 1000) if plan.depth == "16UC1" else z.astype(np.float32)
    return [(topic, stamp, make.image(stamp, frame, plan.depth, np.ascontiguousarray(values)))]


def _write(path: Path, plan: Plan, make: Messages, rows: list[tuple[str, int, Any]]) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    ros1 = plan.kind == "bag"
    storage = StoragePlugin.MCAP if plan.kind == "mcap" else StoragePlugin.SQLITE3
    file = path.with_suffix(".bag") if ros1 else path
    with Writer1(file) if ros1 else Writer2(file, version=8, storage_plugin=storage) as writer:
        connections: dict[str, Any] = {}
        for topic, stamp, message in rows:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=make.store)
            serialize = make.store.serialize_ros1 if ros1 else make.store.serialize_cdr
            writer.write(connections[topic], stamp + 5_000_000_000, serialize(message, kind))
    return file
