"""Estimated and true trajectories in TUM's text format, for evo and other tools: time tx ty tz qx qy qz qw."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from semdb.errors import UsageError
from semdb.evaluation.metrics import EvaluationResult, QueryResult
from semdb.geometry.tum import INDEX_NOTE, TUM_COLUMNS, tum_line

LONGEST_STEM = 200  # bytes, of the 255 that file systems take


def write_trajectories(directory: Path, results: Sequence[EvaluationResult]) -> list[Path]:
    """Two files per result and recording of queries: ``NAME.txt`` with localized queries, ``NAME-truth.txt`` with all.

    NAME is made of recording, method, number of keyframes, and ``refined`` with refined poses. The world is the map's:
    no alignment is needed. Raises UsageError where `directory` cannot be written.
    """
    written: dict[Path, None] = {}
    taken: set[str] = set()
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for result in results:
            for recording in dict.fromkeys(query.recording for query in result.per_query):
                queries = [query for query in result.per_query if query.recording == recording]
                stem = _free(file_stem(recording or result.recording, result), taken)
                for path, text in (
                    (directory / f"{stem}.txt", trajectory_text(queries, estimated=True)),
                    (directory / f"{stem}-truth.txt", trajectory_text(queries, estimated=False)),
                ):
                    path.write_text(text, encoding="utf-8")
                    written[path] = None
    except OSError as error:
        raise UsageError(f"the trajectories cannot be written to {directory}: {error.strerror}") from error
    return list(written)


def file_stem(recording: str, result: EvaluationResult) -> str:
    """A file name without ending: letters, digits, ``_ . + -``."""
    parts = [recording, result.method, str(result.keyframes)] + ["refined"] * (result.truth != "given")
    name = re.sub(r"[^\w.+-]+", "_", "-".join(parts)).strip("_.")
    return name.encode()[-LONGEST_STEM:].decode(errors="ignore")


def _free(stem: str, taken: set[str]) -> str:
    """`stem`, numbered where names that differ became the same one; it is added to `taken`."""
    name, number = stem, 1
    while name in taken:
        number += 1
        name = f"{stem}-{number}"
    taken.add(name)
    return name


def trajectory_text(queries: Iterable[QueryResult], *, estimated: bool) -> str:
    """Poses of localized queries, or true poses of all, in ascending time. Says what the first column is."""
    rows = sorted(queries, key=lambda query: (query.timestamp_ns or 0, query.frame_index))
    timed = all(query.timestamp_ns is not None for query in rows)
    what = "estimated poses of the localized queries" if estimated else "true poses of all queries"
    lines = [f"# {what}, world from camera, metres", TUM_COLUMNS]
    if not timed:
        lines.insert(1, f"# {INDEX_NOTE}")
    for query in rows:
        pose = query.world_from_camera if estimated else query.true_world_from_camera
        if pose is None or (estimated and not query.is_localized):
            continue
        nanoseconds = query.timestamp_ns if timed and query.timestamp_ns is not None else query.frame_index * 10**9
        lines.append(tum_line(nanoseconds, pose))
    return "\n".join(lines) + "\n"
