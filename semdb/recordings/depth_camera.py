"""Depth files of a camera that is not the colour camera, as ``--depth-camera`` says: registered when decoded."""

from __future__ import annotations

import numpy as np

from semdb.errors import UsageError
from semdb.geometry import pose_from
from semdb.recordings.base import FrameEntry, RawColor, RawDepth, Recording
from semdb.recordings.images import decode_depth, read_bytes
from semdb.recordings.intrinsics import camera_problem
from semdb.recordings.options import DEPTH_CAMERA_USAGE, numbers_in
from semdb.recordings.own_depth import DepthCamera, in_color
from semdb.types import Camera


class OwnDepthFiles:
    """Images as they are, and depth of the files as the colour camera sees it."""

    def __init__(self, source: DepthCamera, scale: float, camera: Camera) -> None:
        self._source, self._scale, self._camera = source, scale, camera

    def color(self, entry: FrameEntry) -> RawColor:
        return RawColor(file=read_bytes(entry.image_path))

    def depth(self, entry: FrameEntry) -> RawDepth | None:
        if entry.depth_path is None:
            return None
        own, name = self._source.camera, str(entry.depth_path)
        depth = decode_depth(read_bytes(entry.depth_path), name, self._scale, (own.width, own.height))
        return in_color(depth, self._source, entry.camera or self._camera)


def take_depth_camera(recording: Recording, text: str) -> None:
    """Reads the depth files of `recording` as those of the camera ``fx,fy,cx,cy[,x,y,z]``, of the images' size.

    x, y, z are metres of the depth camera in the colour camera's frame; both look the same way. Raises UsageError.
    """
    numbers = numbers_in(text, (4, 7), DEPTH_CAMERA_USAGE)
    camera = recording.camera
    fx, fy, cx, cy = (float(value) for value in numbers[:4])
    own = Camera(camera.width, camera.height, fx, fy, cx, cy)
    if min(fx, fy) <= 0 or (problem := camera_problem(own)):
        raise UsageError(f"--depth-camera: {problem if min(fx, fy) > 0 else 'fx and fy must be positive'}")
    place = numbers[4:] if len(numbers) == 7 else np.zeros(3)
    recording.notes = (*recording.notes, f"depth is of the camera {text} and registered to colour")
    recording.data = OwnDepthFiles(DepthCamera(own, pose_from(np.eye(3), place)), recording.depth_scale, camera)
