#!/usr/bin/env python3
"""A ROS 2 node that asks a service of semdb where its camera is, and tells the robot.

    pip install 'semdb[client]'
    export SEMDB_TOKEN_FILE=~/semdb-token
    python3 ros2_localizer.py --ros-args -p server:=http://robots.example:8765 -p map:=office \
        -r image:=/camera/color/image_raw -r camera_info:=/camera/color/camera_info

Publishes `pose`, a PoseWithCovarianceStamped of the base in the map at the time of the image, and the transform from
map to odom (REP 105), which holds until the next answer. Answers that are not `localized` are dropped: the odometry
goes on. `-p depth:=true -r depth_image:=/camera/aligned_depth_to_color/image_raw` sends depth, registered to colour.

The map of semdb is ROS' frame `map`: its z should point up (`semdb ingest --up`). semdb gives the pose of the optical
frame (x right, y down, z forward, REP 103), which tf leads to the base. Everything above `main` is tested without ROS.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]

CHANNELS = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4, "mono8": 1, "8UC1": 1, "8UC3": 3}
DEPTHS = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
MILLIMETRES = 1000.0  # REP 118: 16UC1 is millimetres, 32FC1 metres


def image_of(message: Any) -> npt.NDArray[np.uint8]:
    """A sensor_msgs/Image of colour or grey as RGB ``[H, W, 3]``. Raises ValueError for another encoding."""
    channels = CHANNELS.get(message.encoding)
    if channels is None:
        raise ValueError(f"images of {message.encoding} are not taken; of {', '.join(CHANNELS)} they are")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    if message.encoding.startswith(("bgr", "8UC3")):
        pixels = pixels[:, :, 2::-1]
    return np.ascontiguousarray(np.repeat(pixels, 3, axis=2) if channels == 1 else pixels[:, :, :3])


def depth_of(message: Any) -> tuple[npt.NDArray[Any], float | None]:
    """A sensor_msgs/Image of depth ``[H, W]``, and its units per metre; None for floats, which are metres."""
    kind = DEPTHS.get(message.encoding)
    if kind is None:
        raise ValueError(f"depth of {message.encoding} is not taken; of {', '.join(DEPTHS)} it is")
    item = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    values = np.ascontiguousarray(rows[:, : message.width * item.itemsize]).view(item).astype(kind)
    return values, None if kind is np.float32 else MILLIMETRES


def camera_of(info: Any) -> tuple[float, ...]:
    """A sensor_msgs/CameraInfo as fx, fy, cx, cy[, k1, k2, p1, p2, k3]. Raises ValueError for another lens model."""
    fx, _, cx, _, fy, cy = (float(value) for value in info.k[:6])
    lens = [float(value) for value in info.d]
    if not any(lens):
        return fx, fy, cx, cy
    if info.distortion_model not in ("plumb_bob", "rational_polynomial") or any(lens[5:]):
        raise ValueError(
            f"the lens model {info.distortion_model} with {len(lens)} numbers is not taken: rectify images"
        )
    return fx, fy, cx, cy, *(lens + [0.0] * 5)[:5]


def matrix_of(translation: Sequence[float], quat_xyzw: Sequence[float]) -> FloatArray:
    """A transform ``[4, 4]`` of metres and a unit quaternion in ROS' order."""
    x, y, z, w = np.asarray(quat_xyzw, np.float64) / np.linalg.norm(quat_xyzw)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = translation
    return pose


def quat_xyzw_of(pose: FloatArray) -> FloatArray:
    """The rotation of a transform as a unit quaternion ``[4]`` in ROS' order, w not negative."""
    from semdb.geometry import quat_wxyz_from_rotation

    w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3])
    found = np.array([x, y, z, w])
    return -found if w < 0 else found


def inverse(pose: FloatArray) -> FloatArray:
    """The inverse of a rigid transform ``[4, 4]``."""
    found = np.eye(4)
    found[:3, :3] = pose[:3, :3].T
    found[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return found


def base_in_map(world_from_camera: FloatArray, base_from_optical: FloatArray) -> FloatArray:
    """The pose of the base, given that of the optical frame and where that is on the robot (tf: base to optical)."""
    return world_from_camera @ inverse(base_from_optical)


def base_covariance(covariance: FloatArray, world_from_camera: FloatArray, map_from_base: FloatArray) -> FloatArray:
    """The covariance ``[6, 6]`` of the base's pose: translation, then rotation about the map's axes.

    That is ROS' order and meaning (x, y, z, rotation about X, Y, Z, in the frame of the header), and semdb's. What the
    rotation is not sure of moves the base on its lever arm from the camera.
    """
    x, y, z = map_from_base[:3, 3] - world_from_camera[:3, 3]
    moved = np.eye(6)
    moved[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return moved @ covariance @ moved.T


def map_from_odom(map_from_base: FloatArray, odom_from_base: FloatArray) -> FloatArray:
    """What REP 105 wants published: it corrects the drift of the odometry, which publishes odom to base itself."""
    return map_from_base @ inverse(odom_from_base)


def fill_pose(message: Any, stamp: Any, frame: str, pose: FloatArray, covariance: FloatArray) -> Any:
    """Fills a geometry_msgs/PoseWithCovarianceStamped."""
    message.header.stamp, message.header.frame_id = stamp, frame
    fill(message.pose.pose.position, message.pose.pose.orientation, pose)
    message.pose.covariance = [float(value) for value in covariance.ravel()]  # row by row
    return message


def fill_transform(message: Any, stamp: Any, parent: str, child: str, pose: FloatArray) -> Any:
    """Fills a geometry_msgs/TransformStamped."""
    message.header.stamp, message.header.frame_id, message.child_frame_id = stamp, parent, child
    fill(message.transform.translation, message.transform.rotation, pose)
    return message


def fill(place: Any, turn: Any, pose: FloatArray) -> None:
    """Fills a Point or Vector3, and a Quaternion."""
    place.x, place.y, place.z = (float(value) for value in pose[:3, 3])
    turn.x, turn.y, turn.z, turn.w = (float(value) for value in quat_xyzw_of(pose))


def matrix_of_transform(transform: Any) -> FloatArray:
    """A geometry_msgs/Transform as ``[4, 4]``."""
    at, turn = transform.translation, transform.rotation
    return matrix_of((at.x, at.y, at.z), (turn.x, turn.y, turn.z, turn.w))


def main() -> None:
    """Runs the node."""
    import message_filters
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
    from rclpy.duration import Duration
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import CameraInfo, Image
    from tf2_ros import Buffer, TransformBroadcaster, TransformException, TransformListener

    import semdb

    class Localizer(Node):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__("semdb_localizer")
            defaults = {"server": "http://127.0.0.1:8765", "map": "", "depth": False, "base": "base_link"}
            for name, value in (defaults | {"odom": "odom", "frame": "map", "rate": 10.0, "ahead_s": 0.1}).items():
                self.declare_parameter(name, value)
            log = self.get_logger()
            self.db = semdb.connect(self.of("server"), say=log.warning, retries=1, patience_s=5.0, timeout_s=10.0)
            self.buffer = Buffer()
            self.listener = TransformListener(self.buffer, self, spin_thread=True)
            self.sender = TransformBroadcaster(self)
            self.poses = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
            self.newest: tuple[Any, ...] | None = None
            self.turn = threading.Condition()
            self.correction: FloatArray | None = None
            topics = [("image", Image), ("camera_info", CameraInfo)]
            topics += [("depth_image", Image)] if self.of("depth") else []
            listening = [
                message_filters.Subscriber(self, kind, topic, qos_profile=qos_profile_sensor_data)
                for topic, kind in topics
            ]
            self.together = message_filters.ApproximateTimeSynchronizer(listening, 10, 0.02)
            self.together.registerCallback(self.came)
            self.create_timer(1.0 / self.of("rate"), self.tell)
            threading.Thread(target=self.work, daemon=True).start()

        def of(self, name: str) -> Any:
            return self.get_parameter(name).value

        def came(self, *messages: Any) -> None:
            with self.turn:
                self.newest = messages  # one that was not asked yet is too old now
                self.turn.notify()

        def work(self) -> None:
            while rclpy.ok():
                with self.turn:
                    self.turn.wait_for(lambda: self.newest is not None)
                    messages, self.newest = self.newest, None
                try:
                    self.localize(*messages)  # type: ignore[misc]
                except (semdb.SemdbError, ValueError, TransformException) as error:
                    self.get_logger().warning(str(error), throttle_duration_sec=5.0)

        def localize(self, image: Any, info: Any, depth: Any = None) -> None:
            metres, scale = (None, None) if depth is None else depth_of(depth)
            answer = self.db.localize(
                image_of(image),
                map=self.of("map") or None,
                camera=camera_of(info),
                depth=metres,
                depth_scale=scale,
                name=f"{image.header.frame_id} {image.header.stamp.sec}.{image.header.stamp.nanosec:09d}",
                masks=False,
            )
            if not answer.localized:
                self.get_logger().info(f"{answer.verdict}: {answer.reason}", throttle_duration_sec=5.0)
                return
            stamp, base = image.header.stamp, self.of("base")
            mounted = self.between(base, image.header.frame_id, stamp)
            pose = base_in_map(answer.world_from_camera, mounted)
            covariance = base_covariance(answer.covariance, answer.world_from_camera, pose)
            self.poses.publish(fill_pose(PoseWithCovarianceStamped(), stamp, self.of("frame"), pose, covariance))
            self.correction = map_from_odom(pose, self.between(self.of("odom"), base, stamp))

        def between(self, target: str, source: str, stamp: Any) -> FloatArray:
            """``target_from_source`` at the time of the image."""
            found = self.buffer.lookup_transform(target, source, stamp, timeout=Duration(seconds=0.5))
            return matrix_of_transform(found.transform)

        def tell(self) -> None:
            if self.correction is not None:
                later = (self.get_clock().now() + Duration(seconds=self.of("ahead_s"))).to_msg()
                frames = self.of("frame"), self.of("odom")
                self.sender.sendTransform(fill_transform(TransformStamped(), later, *frames, self.correction))

    rclpy.init()
    node = Localizer()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.db.close()
        node.destroy_node()


if __name__ == "__main__":
    main()
