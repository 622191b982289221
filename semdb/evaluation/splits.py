"""Which recordings make the map and which are asked about: the split files of 7-Scenes, or folders by name."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path

from semdb.errors import RecordingError, UsageError
from semdb.evaluation.tasks import PaperPlan, Plan, SplitPlan
from semdb.files import UnusableFileError, numbered_lines, read_text, without_comment
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.recordings.options import ReadOptions
from semdb.types import Camera

TRAIN_FILE, TEST_FILE = "TrainSplit.txt", "TestSplit.txt"
_LINE = re.compile(r"(?:sequence|seq)[-_ ]?0*(\d{1,9})", re.IGNORECASE)


def paper_plans(path: Path, camera: Camera | None = None, reading: ReadOptions | None = None) -> list[Plan]:
    """Protocol `paper`: one plan per recording under `path`. Raises RecordingError."""
    return [PaperPlan(recording) for recording in open_recordings(path, camera, reading)]


def scene_plan(path: Path, camera: Camera | None = None, reading: ReadOptions | None = None) -> SplitPlan:
    """Protocol `split` of a 7-Scenes scene: map from the sequences of TrainSplit.txt, queries from TestSplit.txt.

    Raises UsageError where the two files are missing, RecordingError that names the line of a sequence that is not
    there, or that is in both.
    """
    missing = [name for name in (TRAIN_FILE, TEST_FILE) if not (path / name).is_file()]
    if missing:
        raise UsageError(
            f"{path}: protocol split needs {' and '.join(missing)} there (as in a scene of 7-Scenes), or say "
            "--map-from FOLDER --query-from FOLDER"
        )
    chosen = [split_lines(path / name) for name in (TRAIN_FILE, TEST_FILE)]
    both = set(chosen[0]) & set(chosen[1])
    if both:
        raise RecordingError(f"{path}: sequence{min(both)} is in {TRAIN_FILE} and in {TEST_FILE}")
    halves = [
        tuple(_sequence(path, name, number, camera, reading) for number in numbers)
        for name, numbers in zip((TRAIN_FILE, TEST_FILE), chosen, strict=True)
    ]
    return SplitPlan(path.resolve().name, halves[0], halves[1])


def split_lines(path: Path) -> list[int]:
    """The numbers of the sequences that a split file names. Raises RecordingError with the line."""
    numbers = []
    try:
        lines = numbered_lines(read_text(path, escape=True))
    except UnusableFileError as error:
        raise RecordingError(error.at(path)) from error
    for row, line in lines:
        match = _LINE.fullmatch(without_comment(line))
        if match is None:
            raise RecordingError(f"{path}, line {row}: {line[:80]!r} is no sequence; a line is like 'sequence1'")
        numbers.append(int(match.group(1)))
    if not numbers:
        raise RecordingError(f"{path}: names no sequence")
    return list(dict.fromkeys(numbers))


def folder_plan(
    map_from: Sequence[Path],
    query_from: Sequence[Path],
    camera: Camera | None = None,
    reading: ReadOptions | None = None,
) -> SplitPlan:
    """Protocol `split` of recordings in one world frame that the caller names. Raises UsageError, RecordingError."""
    halves = [
        [found for path in paths for found in open_recordings(path, camera, reading)]
        for paths in (map_from, query_from)
    ]
    same = {found.path.resolve() for found in halves[0]} & {found.path.resolve() for found in halves[1]}
    if same:
        raise UsageError(
            f"{min(same)}: is given to --map-from and to --query-from; for keyframes and queries of one recording "
            "use --protocol paper"
        )
    _tell_apart([*halves[0], *halves[1]])
    names = ", ".join(found.name for found in halves[1])
    return SplitPlan(names, tuple(halves[0]), tuple(halves[1]))


def _sequence(path: Path, name: str, number: int, camera: Camera | None, reading: ReadOptions | None) -> Recording:
    for folder in (f"seq-{number:02d}", f"seq-{number}", f"seq{number:02d}", f"seq{number}"):
        if (path / folder).is_dir():
            [recording] = open_recordings(path / folder, camera, reading)
            return recording
    raise RecordingError(f"{path / name}: names sequence{number}, but there is no folder {path / f'seq-{number:02d}'}")


def tell_apart(plans: Sequence[Plan]) -> list[Plan]:
    """The plans without those that come twice, each with a name of its own: files and tables go by it."""
    once: dict[tuple[object, ...], Plan] = {}
    for plan in plans:
        once.setdefault((type(plan), *(_as_named(recording) for recording in plan.recordings)), plan)
    recordings = [plan.recording for plan in once.values() if isinstance(plan, PaperPlan)]
    _tell_apart(recordings)
    taken = {recording.name for recording in recordings}
    found: list[Plan] = []
    for plan in once.values():
        if not isinstance(plan, SplitPlan):
            found.append(plan)
            continue
        found.append(replace(plan, name=_not_among(taken, plan.name)))
        taken.add(found[-1].name)
    return found


def _tell_apart(recordings: Sequence[Recording]) -> None:
    """Recordings of one name get that of the folder around them in front, and a number where that is not enough."""
    names = [recording.name for recording in recordings]
    taken: set[str] = set()
    for recording in recordings:
        if names.count(recording.name) > 1:
            recording.name = f"{_as_named(recording).parent.name}-{_as_named(recording).name}"
        recording.name = _not_among(taken, recording.name)
        taken.add(recording.name)


def _as_named(recording: Recording) -> Path:
    """The folder as a whole path, without following links."""
    return Path(os.path.abspath(recording.path))


def _not_among(taken: Collection[str], name: str) -> str:
    """`name`, with a number behind it where it is taken."""
    number, found = 1, name
    while found in taken:
        number += 1
        found = f"{name}-{number}"
    return found
