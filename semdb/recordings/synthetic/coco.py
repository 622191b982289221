"""Rendered rooms as instance segmentation data in COCO's format, with exact masks."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semdb.errors import UsageError
from semdb.recordings.synthetic.options import SyntheticOptions
from semdb.recordings.synthetic.writer import SyntheticFrame, SyntheticSequence
from semdb.types import BoolArray

MIN_PIXELS = 24  # smaller objects are not annotated


def write_synthetic_coco(
    directory: Path,
    options: SyntheticOptions,
    rooms: int,
    split: str,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Renders `rooms` rooms, from ``options.room_seed`` on, into ``SPLIT/`` and ``annotations/instances_SPLIT.json``.

    Each room gives ``options.frames`` images from one turn around it. Further splits may go into the same
    `directory`. Raises UsageError when this one is there already.
    """
    images, file = directory / split, directory / "annotations" / f"instances_{split}.json"
    if file.exists() or (images.is_dir() and any(images.iterdir())):
        raise UsageError(f"{directory}: the split {split!r} is there already; give another --split or folder")
    images.mkdir(parents=True, exist_ok=True)
    file.parent.mkdir(exist_ok=True)
    rows: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    names: dict[str, int] = {}
    for room in range(rooms):
        own = replace(options, room_seed=options.room_seed + room, lap_frames=max(8, options.frames))
        sequence = SyntheticSequence(own)
        with ThreadPoolExecutor(2) as pool:
            for index, frame in enumerate(pool.map(sequence.render, range(own.frames))):
                name = f"room{own.room_seed:05d}-{index:05d}.png"
                if not cv2.imwrite(str(images / name), np.ascontiguousarray(frame.rgb[..., ::-1])):
                    raise OSError(f"{images / name}: cannot be written")
                rows.append({"id": len(rows) + 1, "file_name": name, "width": own.width, "height": own.height})
                annotations += _annotations(frame, sequence.classes, len(rows), len(annotations), names)
                if progress is not None:
                    progress(room * own.frames + index + 1, rooms * own.frames)
    categories = [{"id": number, "name": name} for name, number in names.items()]
    file.write_text(json.dumps({"images": rows, "annotations": annotations, "categories": categories}))


def _annotations(
    frame: SyntheticFrame, classes: dict[int, str], image_id: int, count: int, names: dict[str, int]
) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    for label, pixels in zip(*np.unique(frame.labels, return_counts=True), strict=True):
        if label == 0 or pixels < MIN_PIXELS:
            continue
        mask = frame.labels == label
        category = names.setdefault(classes[int(label)], len(names) + 1)
        found.append(
            {
                "id": count + len(found) + 1,
                "image_id": image_id,
                "category_id": category,
                "bbox": list(cv2.boundingRect(mask.view(np.uint8))),
                "area": int(pixels),
                "iscrowd": 0,
                "segmentation": {"size": list(mask.shape), "counts": run_lengths(mask)},
            }
        )
    return found


def run_lengths(mask: BoolArray) -> list[int]:
    """COCO's uncompressed run lengths of `mask` ``[H, W]``: column by column, zeros first."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    runs: Sequence[int] = np.diff(np.concatenate([[0], changes, [flat.size]])).tolist()
    return [0, *runs] if flat[0] else list(runs)
