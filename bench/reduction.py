"""What the reduced scan of the index loses on vectors of real images, by components and by depth of the exact ranking.

``python -m bench.reduction RECORDING... [--vectors N] [--queries N] [--keep FILE] [--json FILE]``, with SEMDB_ENCODER
as for `semdb ingest`. Every frame is encoded many times, each time cropped, turned, mirrored, blurred or lit in
another way, until there are N vectors; some of them, drawn at random, are the queries. Recall@10 is the share
of the exact ten nearest that the reduced scan with exact ranking of the best gives too. ``--keep`` keeps the vectors.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semdb.cli.options import load_settings
from semdb.cli.progress import Progress
from semdb.localization.index.kernels import scan_codes
from semdb.localization.index.reduction import fit_reduction, sample_rows
from semdb.perception.encoders import load_encoder
from semdb.recordings import open_recordings
from semdb.types import Float32Array, ImageArray, Int64Array

COMPONENTS = (32, 64, 96, 128, 192, 256)
DEPTHS = (10, 32, 64, 128, 256, 512)
NEAREST = 10
SHORT_SIDE = 256  # pixels to which frames are made small before they are changed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--vectors", type=int, default=20_000)
    parser.add_argument("--queries", type=int, default=500)
    parser.add_argument("--keep", type=Path, metavar="FILE", help="a .npy file of the vectors, used when it is there")
    parser.add_argument("--json", type=Path, metavar="FILE")
    arguments = parser.parse_args()
    if arguments.keep is not None and arguments.keep.exists():
        vectors = np.load(arguments.keep)
    else:
        vectors = encode_all(arguments.recordings, arguments.vectors)
        if arguments.keep is not None:
            np.save(arguments.keep, vectors)
    result = measure(vectors, arguments.queries)
    show(result)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(result, indent=2) + "\n")


def encode_all(paths: list[Path], count: int) -> Float32Array:
    """Vectors ``[count, d]`` of the frames, each changed in as many ways as it takes."""
    settings = load_settings()
    encoder = load_encoder(settings.encoder, settings)
    frames = list(small_frames(paths))
    random = np.random.default_rng(0)
    vectors = []
    with Progress("encoding", "images") as progress:
        for number in range(count):
            vectors.append(encoder.encode(change(frames[number % len(frames)], random)))
            progress.update(number + 1, count)
    return np.array(vectors, np.float32)


def small_frames(paths: list[Path]) -> Iterator[ImageArray]:
    for recording in [found for path in paths for found in open_recordings(path)]:
        for entry in recording.entries:
            image = recording.read(entry).image
            scale = SHORT_SIDE / min(image.shape[:2])
            yield cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)


def change(image: ImageArray, random: np.random.Generator) -> ImageArray:
    """The image as another camera might have seen it."""
    height, width = image.shape[:2]
    angle, zoom = random.uniform(-12, 12), random.uniform(1.0, 1.8)
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), angle, zoom)
    turn[:, 2] += random.uniform(-0.5, 0.5, 2) * (zoom - 1) * np.array([width, height])
    image = cv2.warpAffine(image, turn, (width, height), borderMode=cv2.BORDER_REFLECT)
    if random.random() < 0.5:
        image = np.ascontiguousarray(image[:, ::-1])
    if random.random() < 0.3:
        image = cv2.GaussianBlur(image, (0, 0), random.uniform(0.5, 2.5))
    light = random.uniform(0.6, 1.4) * random.uniform(0.9, 1.1, (3, 1))
    tones = 255 * (np.arange(256) / 255.0) ** random.uniform(0.7, 1.4) * light + random.uniform(-15, 15)
    table = np.clip(np.rint(tones), 0, 255).astype(np.uint8).T.reshape(1, 256, 3)
    return np.ascontiguousarray(cv2.LUT(image, table), np.uint8)


def measure(vectors: Float32Array, queries: int) -> dict[str, Any]:
    """Recall@10 for all pairs of components and depths."""
    chosen = np.random.default_rng(1).permutation(len(vectors))
    asked, stored = vectors[chosen[:queries]], vectors[chosen[queries:]]
    exact = stored.astype(np.float64) @ asked.T.astype(np.float64)
    best = np.argsort(-exact, axis=0, kind="stable")[:NEAREST].T
    result: dict[str, Any] = {
        "vectors": len(stored),
        "queries": len(asked),
        "numbers": int(vectors.shape[1]),
        "mean_cosine_of_the_tenth": float(np.take_along_axis(exact, best[:, -1:].T, axis=0).mean()),
        "recall": {},
    }
    for components in (c for c in COMPONENTS if c <= vectors.shape[1]):
        reduction = fit_reduction(stored[sample_rows(len(stored))], components, len(stored))
        codes = reduction.encode(stored)
        found = []
        for query, wanted in zip(asked, best, strict=True):
            estimates = np.empty(len(stored), np.float32)
            scan_codes(codes, reduction.query(query)[0], 0, len(codes), estimates)
            found.append(ranks_of(estimates, wanted))
        ranks = np.array(found)
        result["recall"][components] = {depth: float((ranks < depth).mean()) for depth in DEPTHS}
    return result


def ranks_of(estimates: Float32Array, rows: Int64Array) -> Int64Array:
    """Places of these rows in the order of the estimates; a row that is above `depth` is found by the exact ranking."""
    return np.array([np.count_nonzero(estimates > estimates[row]) for row in rows], np.int64)


def show(result: dict[str, Any]) -> None:
    print(f"{result['vectors']} vectors of {result['numbers']} numbers, {result['queries']} queries; recall@{NEAREST}")
    print("components" + "".join(f"{f'best {depth}':>10}" for depth in DEPTHS))
    for components, by_depth in result["recall"].items():
        print(f"{components:10}" + "".join(f"{share:10.4f}" for share in by_depth.values()))


if __name__ == "__main__":
    main()
