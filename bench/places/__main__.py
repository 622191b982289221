"""Which crop, pooling and whitening finds a place again first, by cosine alone.

``python -m bench.places [RECORDING...] [--models FILE...] [--rendered] [--queries N] [--json FILE] [--work DIR]``

Every encoder (`--models`, ONNX files, and gist) describes every frame in every way; keyframes are ranked by the cosine
with a query. Counted are queries of which some keyframe sees at least 0.3 (common view). `first` is the share whose
first keyframe is a right one, which sees at least 0.3, `best` the share whose first sees at least 70 % of what any
does, `mrr` the mean reciprocal rank of the first right one. Whitening is learned from the vectors of the map. The
first recording is to tune with, others judge; `--rendered` has rooms for both. Vectors and rooms are kept in `--work`
and found again. Without `--all` the table has what needs no more than the vectors of today: mean pooling, no flips.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np

from bench.places import suites
from bench.places.crops import VIEWS, Network, atoms, passes, pooled, unit
from bench.places.suites import JUDGE, TUNE, Suite
from semdb.perception.encoders.gist import GistEncoder
from semdb.types import Float32Array

RIGHT, OF_BEST = 0.3, 0.7
SHRINKAGE = (0.1, 1.0)  # of the whitening, in mean variances


@dataclass(frozen=True, slots=True)
class Row:
    """What one way of describing finds in one suite."""

    suite: str
    half: str
    encoder: str
    view: str
    whitening: str
    queries: int
    first: float
    best: float
    mrr: float
    ms: float  # of processor time for an image


def measure(suite: Suite, vectors: Float32Array, whitening: str) -> tuple[int, float, float, float]:
    """Queries that count, and their shares and mean reciprocal rank."""
    stored, asked = vectors[suite.keyframes].astype(np.float64), vectors[suite.queries].astype(np.float64)
    stored, asked = whitened(stored, asked, whitening)
    cosines = np.where(suite.allowed, asked @ stored.T, -np.inf)
    common = np.where(suite.allowed, suite.frames.common[np.ix_(suite.queries, suite.keyframes)], 0.0)
    counted = common.max(axis=1) >= RIGHT
    cosines, common = cosines[counted], common[counted]
    if not len(cosines):
        return 0, np.nan, np.nan, np.nan
    order = np.argsort(-cosines, axis=1, kind="stable")
    ranked = np.take_along_axis(common, order, axis=1)
    right = ranked >= RIGHT
    best = ranked[:, 0] >= OF_BEST * ranked.max(axis=1)
    rank = 1 + right.argmax(axis=1)
    return len(ranked), float(right[:, 0].mean()), float(best.mean()), float((1 / rank).mean())


def whitened(stored: np.ndarray, asked: np.ndarray, whitening: str) -> tuple[np.ndarray, np.ndarray]:
    """Both as they are compared; what is learned is learned from `stored` ``[n, d]``."""
    if whitening == "none":
        return stored, asked
    mean = stored.mean(axis=0)
    stored, asked = stored - mean, asked - mean
    if whitening != "centred":
        _, singular, axes = np.linalg.svd(stored, full_matrices=False)
        axes, variance = axes[singular > 1e-9], singular[singular > 1e-9] ** 2 / len(stored)
        scale = 1 / np.sqrt(variance + float(whitening.split()[1]) * variance.mean())
        stored, asked = stored @ axes.T * scale, asked @ axes.T * scale
    return np.asarray(unit64(stored)), np.asarray(unit64(asked))


def unit64(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12)


def vectors_of(suite: Suite, network: Network | None, work: Path) -> dict[str, Float32Array]:
    """The atoms of the frames of a suite, from `work` where they are there."""
    frames = suite.frames
    name = "gist" if network is None else network.name
    digest = hashlib.sha256(b"".join(image[::16, ::16].tobytes() for image in frames.images)).hexdigest()[:12]
    path = work / f"{name}-{digest}.npz"
    if path.exists():
        with np.load(path) as known:
            return dict(known)
    if network is None:
        encoder, started = GistEncoder(), time.process_time()
        rows = np.stack([encoder.encode(image) for image in frames.images])
        took = 1000 * (time.process_time() - started) / len(rows)
        found = {"whole mean": rows, "ms": np.array(took, np.float32)}
    else:
        found = atoms(network, frames.images, lambda done: _tell(f"{frames.name}: {name}", done, len(frames.images)))
    np.savez(path, **found)
    return found


def rows_of(suite: Suite, networks: Sequence[Network], work: Path) -> list[Row]:
    rows = []
    ways = ["none", "centred", *(f"whitened {gamma:g}" for gamma in SHRINKAGE)]
    known = vectors_of(suite, None, work)
    described = [("gist", "whole", unit(known["whole mean"]), float(known["ms"]))]
    for network in networks:
        known = vectors_of(suite, network, work)
        for view in VIEWS:
            for pooling in ("mean", "gem"):
                for flip in (False, True):
                    vectors = pooled(known, view, pooling, flip)
                    name = view + (", gem" if pooling == "gem" else "") + (", flipped too" if flip else "")
                    if vectors is not None:
                        described.append((network.name, name, vectors, float(known["ms"]) * passes(view, flip)))
    for encoder, view, vectors, ms in described:
        for way in ways:
            count, first, best, mrr = measure(suite, vectors, way)
            rows.append(Row(suite.name, suite.frames.half, encoder, view, way, count, first, best, mrr, ms))
    return rows


def report(rows: Sequence[Row], everything: bool) -> None:
    """A table for each encoder: ways of describing by suite, the share whose first keyframe is among the best."""
    names = list(dict.fromkeys(row.suite for row in rows))
    for number, name in enumerate(names):
        half, count = next((row.half, row.queries) for row in rows if row.suite == name)
        print(f"{number + 1:3} {name}, {count} queries ({half})")
    for figure in ("first", "best", "mrr"):
        print(f"\n{figure}")
        head = "".join(f"{number + 1:>6}" for number in range(len(names)))
        print(f"{'encoder':24}{'view':30}{'whitening':14}{'ms':>6}{head}  tune judge")
        for key in dict.fromkeys((row.encoder, row.view, row.whitening) for row in rows):
            if not everything and ("gem" in key[1] or "flipped" in key[1] or key[2].startswith("whitened 0.1")):
                continue
            own = [row for row in rows if (row.encoder, row.view, row.whitening) == key]
            cells = "".join(f"{getattr(row, figure):6.3f}" for row in own)
            means = [[getattr(row, figure) for row in own if row.half == half] for half in (TUNE, JUDGE)]
            ends = "".join(f"{np.mean(mean):6.3f}" if mean else "     -" for mean in means)
            print(f"{key[0]:24}{key[1]:30}{key[2]:14}{own[0].ms:6.1f}{cells}{ends}")


def _tell(what: str, done: int, total: int) -> None:
    if done % 25 == 0 or done == total:
        print(f"{what}: {done} of {total}", file=sys.stderr, flush=True)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def all_suites(recordings: Sequence[Path], rendered: bool, queries: int, work: Path) -> Iterator[Suite]:
    for number, path in enumerate(recordings):
        yield from suites.recorded(path, TUNE if number == 0 else JUDGE, queries, _say)
    if rendered:
        yield from suites.rendered(work, _say)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--models", nargs="*", type=Path, default=[])
    parser.add_argument("--rendered", action="store_true")
    parser.add_argument("--queries", type=int, default=100, help="at most, of each map")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--work", type=Path, help="vectors are kept here and found again")
    parser.add_argument("--all", action="store_true", help="print all that was measured")
    given = parser.parse_args()
    if not given.recordings and not given.rendered:
        parser.error("name recordings, or --rendered")
    cv2.setNumThreads(1)
    networks = [Network(path) for path in given.models]
    with tempfile.TemporaryDirectory(prefix="semdb-places-") as folder:
        work = given.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        found = all_suites(given.recordings, given.rendered, given.queries, work)
        rows = [row for suite in found for row in rows_of(suite, networks, work)]
    report(rows, given.all)
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")


if __name__ == "__main__":
    main()
