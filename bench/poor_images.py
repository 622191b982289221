"""How many degraded images are localized, and how well.

    python -m bench.poor_images RECORDING... [--keyframes 25] [--queries 25] [--only dark,blur23] [--compare]
        [--json FILE]

Each recording becomes a map (models by SEMDB_DETECTOR and SEMDB_ENCODER), frames between its keyframes are asked,
clean and degraded, and with several recordings in the map of the one named before it, too, where none is right. With
--compare each is asked without what semdb does for poor images besides, and answers that differ are counted.

dark     a fifth of the light, gamma 1.5, noise of 2.5 grey values, 8 bits
blurN    motion of N pixels in one of eight directions, drawn for each image, and noise of 1 grey value
jpegQ    JPEG of quality Q
small    a third of the resolution, up again
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from unittest import mock

import cv2
import numpy as np

import semdb
from semdb.door.values import Answer
from semdb.geometry import pose_error
from semdb.recordings import open_recording
from semdb.types import Frame

KINDS = ("clean", "dark", "blur9", "blur15", "blur23", "jpeg20", "jpeg8", "small")
DIRECTIONS = 8
SHOWN = ("perception.describe", "localization.fallback")  # who gives images contrast


def motion_kernel(length: float, degrees: float) -> np.ndarray:
    """A line of `length` pixels through the middle, its ends weighed by how much of a pixel they cover."""
    half = int(np.ceil(length / 2)) + 1
    offsets = np.linspace(-length / 2, length / 2, 16 * int(length) + 1)
    x, y = (offsets * f(np.radians(degrees)) + half for f in (np.cos, np.sin))
    kernel = np.zeros((2 * half + 2, 2 * half + 2))
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - x % 1) * np.abs(1 - dy - y % 1)
            np.add.at(kernel, ((y.astype(int) + dy), (x.astype(int) + dx)), weight)
    kernel = kernel[: 2 * half + 1, : 2 * half + 1]
    return kernel / kernel.sum()


def degraded(image: np.ndarray, kind: str, rng: np.random.Generator) -> np.ndarray:
    """`image` RGB ``[H, W, 3]`` as `kind` makes it."""
    if kind == "clean":
        return image
    if kind == "dark":
        light = 255 * (image / 255.0) ** 1.5 * 0.2
        return np.clip(np.rint(light + rng.normal(0, 2.5, image.shape)), 0, 255).astype(np.uint8)
    if kind.startswith("blur"):
        kernel = motion_kernel(float(kind[4:]), rng.integers(DIRECTIONS) * 180 / DIRECTIONS)
        smeared = cv2.filter2D(image.astype(np.float32), -1, kernel, borderType=cv2.BORDER_REPLICATE)
        return np.clip(np.rint(smeared + rng.normal(0, 1, image.shape)), 0, 255).astype(np.uint8)
    if kind.startswith("jpeg"):
        _, data = cv2.imencode(".jpg", image[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, int(kind[4:])])
        return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[:, :, ::-1])
    height, width = image.shape[:2]
    down = cv2.resize(image, (width // 3, height // 3), interpolation=cv2.INTER_AREA)
    return cv2.resize(down, (width, height), interpolation=cv2.INTER_LINEAR)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--keyframes", type=int, default=25)
    parser.add_argument("--queries", type=int, default=25)
    parser.add_argument("--offset", type=int, default=0, help="another value asks other frames")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default=",".join(KINDS))
    parser.add_argument("--compare", action="store_true", help="ask without what is done for poor images, too")
    parser.add_argument("--database", help="keep the maps in this SQLite file, and use them again")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    results = []
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{arguments.database or folder + '/poor.sqlite3'}"
        with semdb.open(url) as db:
            for path, before in zip(arguments.recordings, [None, *arguments.recordings[:-1]], strict=True):
                results += measure(db, path, None if before is None else before.name, arguments)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(results, indent=1) + "\n")


@contextlib.contextmanager
def unmended(db: semdb.Database) -> Iterator[None]:
    """Images are taken as they are meanwhile: neither stretched nor are keyframes blurred alike."""
    localizers = [entry.localizer for entry in db._here.maps().asked(None, "index")]
    before = [localizer.fine for localizer in localizers]
    plain = {f"semdb.{name}.with_contrast": lambda image: (image, None) for name in SHOWN}
    with contextlib.ExitStack() as stack:
        for name, function in plain.items():
            stack.enter_context(mock.patch(name, function))
        for localizer in localizers:
            localizer.fine = replace(localizer.fine, options=replace(localizer.fine.options, blur=None))
        yield
    for localizer, fine in zip(localizers, before, strict=True):
        localizer.fine = fine


def measure(
    db: semdb.Database, path: Path, other: str | None, arguments: argparse.Namespace
) -> list[dict[str, object]]:
    recording = open_recording(path)
    name = path.name
    if not Path(str(arguments.database)).exists() or name not in [known.name for known in db.maps()]:
        db.ingest(path, map=name, keyframes=arguments.keyframes)
        db.refine(name)
    stored = {keyframe.frame_index for keyframe in db.keyframes(name)}
    entries = [e for e in recording.entries if e.index not in stored and e.world_from_camera is not None]
    step = max(1, len(entries) // arguments.queries)
    frames = [recording.read(entry) for entry in entries[arguments.offset :: step][: arguments.queries]]
    results: list[dict[str, object]] = []
    for kind in arguments.only.split(","):
        rng = np.random.default_rng(arguments.seed)
        poor = [degraded(frame.image, kind, rng) for frame in frames]
        answers = asked(db, frames, poor, name)
        found: dict[str, object] = {"recording": name, "kind": kind, **scores(frames, answers)}
        if arguments.compare:
            with unmended(db):
                plain = asked(db, frames, poor, name)
            found["without"] = scores(frames, plain)
            found["changed"] = sum(not same(*pair) for pair in zip(answers, plain, strict=True))
        if other is not None:
            found["elsewhere"] = sum(answer.localized for answer in asked(db, frames, poor, other))
        results.append(found)
        show(found)
    return results


def asked(db: semdb.Database, frames: Sequence[Frame], images: Sequence[np.ndarray], map_name: str) -> list[Answer]:
    return [
        db.localize(image, camera=frame.camera, map=map_name, log=False)
        for frame, image in zip(frames, images, strict=True)
    ]


def same(one: Answer, other: Answer) -> bool:
    """Whether two answers agree to the last bit."""
    return one.verdict == other.verdict and np.array_equal(one.world_from_camera, other.world_from_camera)


def scores(frames: Sequence[Frame], answers: Sequence[Answer]) -> dict[str, object]:
    rows = []
    for frame, answer in zip(frames, answers, strict=True):
        metres, degrees = np.inf, np.inf
        if answer.world_from_camera is not None and frame.world_from_camera is not None:
            metres, degrees = pose_error(answer.world_from_camera, frame.world_from_camera)
        rows.append((frame.index, str(answer.verdict), metres, degrees, answer.inliers, answer.reason))
    localized = [row for row in rows if row[1] == "localized"]
    return {
        "queries": len(rows), "localized": len(localized),
        "false": sum(m > 0.25 or d > 5 for _, _, m, d, *_ in localized),
        "within": sum(m <= 0.05 and d <= 5 for _, _, m, d, *_ in localized),
        "median_m": float(np.median([row[2] for row in localized])) if localized else None,
        "median_deg": float(np.median([row[3] for row in localized])) if localized else None,
        "median_inliers": float(np.median([row[4] for row in rows])), "rows": rows,
    }  # fmt: skip


def show(found: dict[str, object]) -> None:
    def number(value: object, digits: int) -> str:
        return f"{value:.{digits}f}" if isinstance(value, float) else "none"

    def line(of: dict[str, object]) -> str:
        return (
            f"{of['localized']} of {of['queries']} localized, {of['false']} false, {of['within']} within 5 cm and "
            f"5 deg, median {number(of['median_m'], 4)} m {number(of['median_deg'], 2)} deg, "
            f"{number(of['median_inliers'], 0)} inliers"
        )

    print(f"{found['recording']} {found['kind']}: {line(found)}", flush=True)
    if isinstance(found.get("without"), dict):
        print(f"  without: {line(found['without'])}; {found['changed']} answers differ", flush=True)  # type: ignore[arg-type]
    if "elsewhere" in found:
        print(f"  in the map of another recording: {found['elsewhere']} localized", flush=True)


if __name__ == "__main__":
    main()
