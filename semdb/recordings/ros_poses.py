"""Poses of the colour camera of a bag: from transforms, else from odometry, poses or a path."""

from __future__ import annotations

from typing import Any

import numpy as np

from semdb.errors import UsageError
from semdb.recordings.options import ReadOptions
from semdb.recordings.ros_reader import ODOMETRY, OLD_TF, PATH, POSE, POSE_WITH_COVARIANCE, TF, TRANSFORM, Bag
from semdb.recordings.ros_tf import TransformTree, best_world, unit
from semdb.types import FloatArray

STATIC = "tf_static"
_OF_THE_CAMERA = (POSE, POSE_WITH_COVARIANCE, PATH, TRANSFORM)


def read_transforms(bag: Bag, camera_frame: str, notes: list[str]) -> TransformTree:
    """All that a bag says of where frames are: what tf says first, then odometry, then poses.

    Poses and paths name no frame that hangs: they are taken to be the camera's (noted).
    """
    tree = TransformTree()
    by_kind: dict[str, list[str]] = {}
    for topic in bag.topics:
        if topic.messages:
            by_kind.setdefault(topic.kind, []).append(topic.name)
    for kind in (TF, OLD_TF):
        for name in by_kind.get(kind, []):
            for message in bag.messages([name]):
                for transform in bag.decode(message).transforms:
                    _add_transform(tree, transform, name)
    for name in by_kind.get(ODOMETRY, []):
        _add_odometry(tree, bag, name, camera_frame)
    if not tree.moves(camera_frame):
        for kind in _OF_THE_CAMERA:
            for name in by_kind.get(kind, []):
                if _add_poses(tree, bag, name, kind, camera_frame):
                    notes.append(
                        f"no transform moves {camera_frame!r}: poses of {name} are taken to be the camera's own"
                    )
                    return tree
    return tree


class CameraPoses:
    """The pose of the camera in the world frame at any time."""

    def __init__(self, tree: TransformTree, frame: str, options: ReadOptions, notes: list[str]) -> None:
        """Raises UsageError for a world frame that is not there or that the camera does not hang from."""
        self._tree, self._frame, self._options = tree, frame, options
        self.world = options.world_frame.lstrip("/") if options.world_frame else best_world(tree, frame)
        if options.world_frame and self.world not in tree.frames():
            frames = ", ".join(tree.frames()) or "none"
            raise UsageError(f"--world-frame {options.world_frame}: there is no such frame; there are {frames}")
        self.known = self.world is not None
        self.topics = tuple(dict.fromkeys(edge.source for edge in tree.moves(frame))) if self.known else ()
        if self.world is None:
            notes.append(_no_poses(tree, frame))
        elif not options.world_frame:
            chain = " > ".join(reversed(tree.above(frame)))
            notes.append(f"poses of {frame!r} in {self.world!r} ({chain}); --world-frame takes another")

    def at(self, time_ns: int) -> tuple[FloatArray | None, str]:
        """``world_from_camera`` ``[4, 4]`` at a time of colour; None and the reason."""
        if self.world is None:
            return None, "no pose"
        pose, reason = self._tree.pose(self.world, self._frame, time_ns - round(self._options.time_offset_ms * 1e6))
        return (None, reason) if pose is None else (self._options.pose(pose), "")


def _no_poses(tree: TransformTree, frame: str) -> str:
    frames = tree.frames()
    if not frames:
        return "no /tf, odometry or poses: the frames have no pose"
    return (
        f"no transform moves the camera's frame {frame!r} (there are {', '.join(frames[:12])}): the frames have no pose"
    )


def _add_transform(tree: TransformTree, transform: Any, topic: str) -> None:
    q, t = transform.transform.rotation, transform.transform.translation
    _add(tree, transform.header, transform.child_frame_id, q, t, topic, static=topic.rsplit("/", 1)[-1] == STATIC)


def _add_odometry(tree: TransformTree, bag: Bag, name: str, camera_frame: str) -> None:
    """Poses of the frame that the odometry names, unless tf says where that is; of the camera without a name."""
    for number, message in enumerate(bag.messages([name])):
        odometry = bag.decode(message)
        child = str(odometry.child_frame_id) or camera_frame
        if number == 0 and tree.has_parent(child):
            return
        pose = odometry.pose.pose
        _add(tree, odometry.header, child, pose.orientation, pose.position, name, static=False)


def _add_poses(tree: TransformTree, bag: Bag, name: str, kind: str, camera_frame: str) -> bool:
    """Poses of a topic as the camera's. Returns whether there were any."""
    if tree.has_parent(camera_frame):
        camera_frame = tree.above(camera_frame)[-1]  # of the top of what it is fixed to
    found = False
    if kind == PATH:
        last = None
        for message in bag.messages([name]):
            last = message
        stamped = [] if last is None else list(bag.decode(last).poses)
    else:
        stamped = [bag.decode(message) for message in bag.messages([name])]
    for value in stamped:
        if kind == TRANSFORM:
            q, t = value.transform.rotation, value.transform.translation
        else:
            pose = value.pose.pose if kind == POSE_WITH_COVARIANCE else value.pose
            q, t = pose.orientation, pose.position
        header = value.header
        found |= _add(tree, header, camera_frame, q, t, name, static=False)
    return found


def _add(tree: TransformTree, header: Any, child: str, q: Any, t: Any, source: str, *, static: bool) -> bool:
    quat_wxyz = unit((q.x, q.y, q.z, q.w))
    translation = np.array([t.x, t.y, t.z], dtype=np.float64)
    if quat_wxyz is None or not np.isfinite(translation).all():
        return False
    stamp = int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)
    tree.add(str(header.frame_id) or "world", str(child), (stamp, quat_wxyz, translation), static=static, source=source)
    return True
