"""How fast a bag is ingested against the same frames as PNG files.

``python -m bench.bags RECORDING [--frames N] [--keyframes N] [--rounds N] [--json FILE]``, SEMDB_DETECTOR and
SEMDB_ENCODER as for `semdb ingest`. The first frames of a recording are written as PNG files in the layout of TUM
RGB-D, and as bags of ROS 1 and ROS 2 (MCAP), uncompressed and compressed (PNG and compressedDepth). Printed for each:
size, CPU time of looking at colour and depth of every frame, CPU time of the whole ingest into SQLite (opening,
selection, networks, rows), and what these are of the PNG files'.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semdb.cli.options import load_settings
from semdb.geometry import quat_wxyz_from_rotation
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings import open_recording
from semdb.types import Frame

FIRST_NS, STEP_NS = 1_000_000_000_000, 33_333_333
KINDS = ("ros1 raw", "mcap raw", "mcap compressed")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--keyframes", type=int, default=10)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="semdb-bags-") as temporary:
        rows = measure(arguments, Path(temporary))
    for row in rows:
        print(
            f"{row['format']:16} {row['megabytes']:8.1f} MB  read {row['read_s']:6.2f} s ({row['read_ratio']:.2f})  "
            f"ingest {row['ingest_s']:6.2f} s ({row['ingest_ratio']:.2f})"
        )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


def measure(arguments: argparse.Namespace, folder: Path) -> list[dict[str, Any]]:
    recording = open_recording(arguments.recording)
    frames = [recording.read(entry) for entry in recording.entries[: arguments.frames]]
    frames = [frame for frame in frames if frame.depth is not None and frame.world_from_camera is not None]
    places = {"png": write_png(folder / "png", frames)}
    places |= {kind: write_bag(folder / kind.replace(" ", "-"), frames, kind) for kind in KINDS}
    reads: dict[str, list[float]] = {kind: [] for kind in places}
    ingests: dict[str, list[float]] = {kind: [] for kind in places}
    for number in range(arguments.rounds + 1):  # the first one loads what is loaded once
        for kind, place in places.items():
            read = seconds(lambda place=place: look(place))  # type: ignore[misc]
            url = f"sqlite:///{folder / f'{number}-{kind}.sqlite3'}"
            settings = load_settings(database_url=url, check_recordings=False)
            options = IngestOptions(keyframes=arguments.keyframes)
            whole = seconds(lambda p=place, s=settings, o=options: ingest_recordings([p], s, o))  # type: ignore[misc]
            if number:
                reads[kind].append(read)
                ingests[kind].append(whole)
    rows = []
    for kind, place in places.items():
        read, whole = statistics.median(reads[kind]), statistics.median(ingests[kind])
        files = [place] if place.is_file() else [file for file in place.rglob("*") if file.is_file()]
        rows.append({
            "format": kind, "frames": len(frames), "keyframes": arguments.keyframes,
            "megabytes": sum(file.stat().st_size for file in files) / 1e6, "read_s": read, "ingest_s": whole,
            "read_ratio": statistics.median(np.divide(reads[kind], reads["png"])),
            "ingest_ratio": statistics.median(np.divide(ingests[kind], ingests["png"])),
        })  # fmt: skip
    return rows


def seconds(work: Callable[[], Any]) -> float:
    """CPU time of all threads: what else runs on the machine does not count."""
    started = time.process_time()
    work()
    return time.process_time() - started


def look(place: Path) -> None:
    """Decodes colour and depth of every frame, as the selection of keyframes does."""
    recording = open_recording(place)
    for entry in recording.entries:
        recording.read_image(entry)
        recording.read_depth(entry)


def png(values: np.ndarray) -> bytes:
    """A PNG file as cameras' programs write it."""
    return cv2.imencode(".png", values)[1].tobytes()


def depth_units(frame: Frame) -> np.ndarray:
    """Millimetres, as sensors and bags have them."""
    return np.rint(np.nan_to_num(1000 * frame.depth, nan=0)).clip(0, 65534).astype(np.uint16)  # type: ignore[operator]


def write_png(folder: Path, frames: list[Frame]) -> Path:
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for number, frame in enumerate(frames):
        time_s = f"{(FIRST_NS + number * STEP_NS) / 1e9:.9f}"
        for name, values in (("rgb", frame.image[..., ::-1]), ("depth", depth_units(frame))):
            (folder / name / f"{number}.png").write_bytes(png(values))
            lists[name].append(f"{time_s} {name}/{number}.png")
        pose = frame.world_from_camera
        assert pose is not None
        w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3])
        lists["groundtruth"].append(f"{time_s} " + " ".join(repr(float(v)) for v in (*pose[:3, 3], x, y, z, w)))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    camera = frames[0].camera
    content = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    content |= {"distortion": list(camera.distortion), "depth_scale": 1000}
    (folder / "camera.json").write_text(json.dumps(content))
    return folder


def write_bag(folder: Path, frames: list[Frame], kind: str) -> Path:
    """A bag of ROS with the same frames; the tests have what makes messages."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    from tests.unit.bags import COLOR, DEPTH, Messages

    ros1, raw, frame_id = kind.startswith("ros1"), kind.endswith("raw"), "camera"
    make = Messages(ros1)
    path = folder.with_suffix(".bag") if ros1 else folder
    writer = Writer1(path) if ros1 else Writer2(path, version=8, storage_plugin=StoragePlugin.MCAP)
    with writer:
        topics: dict[str, Any] = {}
        for number, frame in enumerate(frames):
            stamp = FIRST_NS + number * STEP_NS
            units, camera, pose = depth_units(frame), frame.camera, frame.world_from_camera
            assert pose is not None
            five = (*camera.distortion, *([0.0] * 5))[:5]
            messages = {
                "/tf": make.tf(make.transform(stamp, "map", frame_id, pose)),
                "/camera/color/camera_info": make.info(stamp, frame_id, camera, "plumb_bob", five),
            }
            if raw:
                messages[COLOR] = make.image(stamp, frame_id, "rgb8", frame.image, padding=0)
                messages[DEPTH] = make.image(stamp, frame_id, "16UC1", units, padding=0)
            else:
                body = bytes(12) + png(units)
                picture = png(frame.image[..., ::-1])
                messages[f"{COLOR}/compressed"] = make.compressed(stamp, frame_id, "rgb8; png compressed bgr8", picture)
                messages[f"{DEPTH}/compressedDepth"] = make.compressed(
                    stamp, frame_id, "16UC1; compressedDepth png", body
                )
            for topic, message in messages.items():
                name = message.__msgtype__
                if topic not in topics:
                    topics[topic] = writer.add_connection(topic, name, typestore=make.store)  # type: ignore[union-attr]
                serialise = make.store.serialize_ros1 if ros1 else make.store.serialize_cdr
                writer.write(topics[topic], stamp, serialise(message, name))
    return path if ros1 else next(path.glob("*.mcap"))


if __name__ == "__main__":
    main()
