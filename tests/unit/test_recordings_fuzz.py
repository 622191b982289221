"""Files cut off, or with a byte changed, anywhere: one error, or frames; never a traceback, a hang or much memory."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from semdb.errors import RecordingError, UsageError
from semdb.recordings import open_recordings
from semdb.recordings.options import ReadOptions
from tests.unit.bags import Plan, write_bag
from tests.unit.model_files import write_colmap, write_kapture
from tests.unit.recording_formats import (
    write_nice_slam,
    write_polycam,
    write_record3d,
    write_redwood,
    write_rtabmap,
    write_scannet_folder,
    write_sens,
    write_stray,
)
from tests.unit.recording_miniatures import write_povray

MOST_SECONDS, MOST_WAITED = 20, 200  # of work, and of time, in which other processes work, too
MOST_KIB = 2 << 20  # beyond what the process held before
WRITERS: dict[str, Callable[[Path], Path]] = {
    "bag": lambda path: write_bag(path, Plan("bag", 2)),
    "db3": lambda path: next(write_bag(path, Plan("db3", 2)).glob("*.db3")),
    "mcap": lambda path: next(write_bag(path, Plan("mcap", 2, depth="16UC1 rvl")).glob("*.mcap")),
    "sens": lambda path: write_sens(path.with_suffix(".sens"), 2),
    "rtabmap": lambda path: write_rtabmap(path.with_suffix(".db")),
    "record3d": lambda path: write_record3d(path.with_suffix(".r3d"), 2),
    "stray": lambda path: write_stray(path, 3),
    "polycam": lambda path: write_polycam(path, 2),
    "scannet": lambda path: write_scannet_folder(path, 2),
    "nice_slam": lambda path: write_nice_slam(path / "room", 2),
    "redwood": lambda path: write_redwood(path, 2),
    "colmap_text": lambda path: write_colmap(path, 2),
    "colmap_binary": lambda path: write_colmap(path, 2, binary=True),
    "kapture": lambda path: write_kapture(path, 2),
    "povray": lambda path: write_povray(path, 2),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Whole recordings, each made once."""
    made: dict[str, Path] = {}

    def of(name: str) -> Path:
        if name not in made:
            made[name] = WRITERS[name](tmp_path_factory.mktemp(name) / "recording")
            open_and_decode(made[name])  # kernels are compiled when they are first used
        return made[name]

    return of


def memory(of: str) -> int:
    """KiB of this process: ``VmRSS`` now, ``VmHWM`` at most since the last ``forget_peak``."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(of + ":"))


def forget_peak() -> None:
    """The peak counts from now on: tests that ran before in this process have one of their own."""
    Path("/proc/self/clear_refs").write_text("5")


def open_and_decode(path: Path) -> None:
    """All frames of a recording. Raises whatever reading it raises."""
    for recording in open_recordings(path, options=ReadOptions(scale=1.0) if path.is_dir() else None):
        for _ in recording.frames():
            pass


def read(path: Path) -> None:
    """Opens and decodes all that can be; whatever else than an error of a user's kind fails the test."""
    forget_peak()
    started, message, before = (time.process_time(), time.monotonic()), "", memory("VmRSS")
    try:
        open_and_decode(path)
    except (RecordingError, UsageError) as error:
        message = str(error)
    assert "\n" not in message
    assert time.process_time() - started[0] < MOST_SECONDS
    assert time.monotonic() - started[1] < MOST_WAITED
    assert memory("VmHWM") - before < MOST_KIB


def damage_one(source: Path, target: Path, choose: int, place: float, value: int | None) -> Path:
    """A copy of a recording of which one file is cut off (`value` None) or has one byte changed at a share of it."""
    if target.exists():
        shutil.rmtree(target) if target.is_dir() else target.unlink()
    if source.is_dir():
        shutil.copytree(source, target)
        files = sorted(file for file in target.rglob("*") if file.is_file())
        file = files[choose % len(files)]
    else:
        file = target.with_suffix(source.suffix)
        shutil.copyfile(source, file)
        target = file
    data = bytearray(file.read_bytes())
    at = min(int(place * len(data)), len(data) - 1)
    if value is None:
        data = data[:at]
    elif data:
        data[at] = value
    file.write_bytes(bytes(data))
    return target


def damaged(count: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Hypothesis over which file, where, and what; the examples of a run are always the same."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        return settings(
            max_examples=count,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
        )(
            given(
                choose=st.integers(0, 30),
                place=st.floats(0, 1, exclude_max=True),
                value=st.none() | st.integers(0, 255),
            )(function)
        )

    return decorate


@pytest.mark.parametrize("name", sorted(WRITERS))
@damaged(8)
def test_damaged_files(
    written: Callable[[str], Path], tmp_path: Path, name: str, choose: int, place: float, value: int | None
) -> None:
    read(damage_one(written(name), tmp_path / "damaged", choose, place, value))


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(WRITERS))
@damaged(400)
def test_many_damaged_files(
    written: Callable[[str], Path], tmp_path: Path, name: str, choose: int, place: float, value: int | None
) -> None:
    read(damage_one(written(name), tmp_path / "damaged", choose, place, value))
