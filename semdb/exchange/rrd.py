"""Keyframes as a recording of rerun (``.rrd``): cameras with their images and depth, and the way they took."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from semdb.database.records import KeyframeHead, StoredImage
from semdb.errors import FrameError, UsageError
from semdb.exchange.source import ExportOptions, MapSource, decoded, new_file
from semdb.recordings.images import encode_16bit
from semdb.recordings.own_depth import as_raw

KEYFRAME, TIME = "keyframe", "time"  # timelines: the position in the export, and when it was taken
MEDIA = {"jpeg": "image/jpeg", "png": "image/png"}


def write_rrd(source: MapSource, out: Path, options: ExportOptions) -> str:
    """``map/RECORDING/camera`` for each keyframe, ``map/RECORDING/path`` once. Images stay the files that they are.

    Raises UsageError without the rerun extra, or where rerun is switched off.
    """
    try:
        import rerun
    except ImportError as error:
        raise UsageError("the format rrd needs the rerun extra: pip install 'semdb[rerun]'") from error
    new_file(out)
    stream = rerun.RecordingStream("semdb", recording_id=source.name)
    if not stream.is_enabled():
        raise UsageError("rerun is switched off: the variable RERUN must not be off")
    stream.set_log_time_enabled(False)  # when it was exported
    stream.set_log_tick_enabled(False)
    try:
        stream.save(out)
    except RuntimeError as error:  # all that rerun says of a folder that takes no files
        stream.disconnect()
        raise UsageError(f"{out}: cannot be written: {error}") from error
    try:
        with_depth = _write(rerun, stream, source)
        stream.flush()
    except BaseException:
        stream.disconnect()
        out.unlink(missing_ok=True)
        raise
    stream.disconnect()
    return f"{len(source.heads)} cameras, {with_depth} with depth"


def _write(rerun: Any, stream: Any, source: MapSource) -> int:
    for recording in dict.fromkeys(head.recording for head in source.heads):
        way = [head.world_from_camera[:3, 3] for head in source.heads if head.recording == recording]
        path = f"map/{source.folders[recording]}/path"
        stream.log(path, rerun.LineStrips3D([np.array(way, np.float32)]), static=True)
    with_depth = 0
    for number, head in enumerate(source.heads):
        stream.set_time(KEYFRAME, sequence=number)
        if head.timestamp_ns is None:
            stream.disable_timeline(TIME)
        else:
            stream.set_time(TIME, timestamp=np.datetime64(head.timestamp_ns, "ns"))
        with_depth += _keyframe(rerun, stream, f"map/{source.folders[head.recording]}/camera", head, source)
        source.tell("exporting", number + 1)
    return with_depth


def _keyframe(rerun: Any, stream: Any, path: str, head: KeyframeHead, source: MapSource) -> int:
    """Pose, intrinsics (rerun's have no distortion), image and depth of a keyframe; 1 where it has depth."""
    camera, pose, stored = head.camera, head.world_from_camera, source.image(head.id)
    stream.log(path, rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    matrix = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
    size = [camera.width, camera.height]
    axes = rerun.ViewCoordinates.RDF
    stream.log(path, rerun.Pinhole(image_from_camera=matrix, resolution=size, camera_xyz=axes))
    stream.log(f"{path}/image", _image(rerun, head, stored))
    depth = _depth(head, stored)
    if depth is None:
        stream.log(f"{path}/depth", rerun.Clear(recursive=False))
        return 0
    stream.log(f"{path}/depth", rerun.EncodedDepthImage(depth[0], media_type="image/png", meter=depth[1]))
    return 1


def _image(rerun: Any, head: KeyframeHead, stored: StoredImage) -> Any:
    if stored.rgb_format in MEDIA:
        return rerun.EncodedImage(contents=stored.rgb, media_type=MEDIA[stored.rgb_format])
    return rerun.Image(decoded(stored, head)[0])


def _depth(head: KeyframeHead, stored: StoredImage) -> tuple[bytes, float] | None:
    """Depth registered to colour as a PNG file of 16 bits, and its units a metre; None where there is none."""
    if stored.depth is None or stored.depth_scale is None:
        return None
    if not stored.depth_registration and stored.depth_format == "png":
        return stored.depth, stored.depth_scale
    try:
        depth = decoded(stored, head)[1]
    except FrameError:
        return None
    if depth is None:
        return None
    raw = as_raw(depth)
    return encode_16bit(raw.values), raw.scale
