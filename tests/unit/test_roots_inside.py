"""Files of recordings lie where recordings may lie, whatever lists and links inside of them say."""

from __future__ import annotations

import json
import os
import shutil
import threading
from pathlib import Path

import pytest

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.files import UnusableFileError, check_place, only_below, read_bytes
from semdb.ingestion.run import IngestOptions, open_all
from semdb.recordings.base import Recording
from semdb.recordings.roots import places_of
from semdb.recordings.source import locate
from semdb.settings import Settings
from tests.unit.recording_miniatures import write_tum

OUTSIDE = "outside of where recordings may lie"


@pytest.fixture
def inside(tmp_path: Path) -> Path:
    return write_tum(tmp_path / "roots" / "walk", n=6)


def opened(folder: Path, root: Path | None) -> Recording:
    settings = Settings(recording_roots=None if root is None else str(root), cache_dir=folder / "cache")
    [recording] = open_all([folder], settings, IngestOptions())
    return recording


def test_a_list_that_climbs(inside: Path) -> None:
    secret = shutil.copy(next((inside / "rgb").iterdir()), inside.parent.parent / "secret.png")
    lines = (inside / "rgb.txt").read_text().splitlines()
    first = next(number for number, line in enumerate(lines) if not line.startswith("#"))
    time, name = lines[first].split()
    for other in (os.path.relpath(secret, inside), str(secret)):
        lines[first] = f"{time} {other}"
        (inside / "rgb.txt").write_text("\n".join(lines))
        anywhere = opened(inside, None)
        assert len(anywhere.entries) == 6
        recording = opened(inside, inside.parent)
        assert len(recording.entries) == 5
        [dropped] = recording.dropped
        assert OUTSIDE in dropped.reason
    assert name


def test_links_that_lead_out(inside: Path) -> None:
    out = inside.parent.parent / "elsewhere"
    out.mkdir()
    for name in ("rgb", "depth"):
        shutil.move(inside / name, out / name)
        (inside / name).symlink_to(out / name)
    assert len(opened(inside, None).entries) == 6
    with pytest.raises(RecordingError, match=OUTSIDE):
        opened(inside, inside.parent)
    assert len(opened(inside, inside.parent.parent).entries) == 6  # the root holds both


@pytest.mark.parametrize("name", ["groundtruth.txt", "rgb.txt", "camera.json"])
def test_text_of_other_files_is_not_told(inside: Path, name: str) -> None:
    """Not in the error either."""
    secret = inside.parent.parent / "secret"
    secret.write_text(json.dumps({"password": "hunter2"}))
    (inside / name).unlink(missing_ok=True)
    (inside / name).symlink_to(secret)
    with pytest.raises(RecordingError) as caught:
        opened(inside, inside.parent)
    assert OUTSIDE in str(caught.value)
    assert "hunter2" not in str(caught.value)


def test_a_link_that_is_made_when_the_recording_is_open(inside: Path) -> None:
    """And whichever thread reads it."""
    recording = opened(inside, inside.parent)
    entry = recording.entries[2]
    secret = shutil.move(entry.image_path, inside.parent.parent / "secret.png")
    Path(entry.image_path).symlink_to(secret)
    found: list[str] = []

    def read() -> None:
        with pytest.raises(FrameError, match=OUTSIDE) as caught:
            recording.read(entry)
        found.append(str(caught.value))

    thread = threading.Thread(target=read)
    thread.start()
    thread.join()
    read()
    assert len(found) == 2
    assert recording.read(recording.entries[0]).image.shape[2] == 3


def test_places(tmp_path: Path) -> None:
    assert places_of((), tmp_path) == ()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    (tmp_path / "real").mkdir()
    roots = [str(tmp_path / "link"), "s3://bucket/rooms", f"file://{tmp_path}/a%20b"]
    assert places_of(roots, tmp_path / "copies") == (tmp_path / "real", tmp_path / "a b", tmp_path / "copies")
    with pytest.raises(UsageError, match="SEMDB_RECORDING_ROOTS"):
        locate(str(tmp_path), Settings(recording_roots=str(tmp_path / "real")))


def test_only_below_is_of_the_block_alone(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_bytes(b"x")
    with only_below([tmp_path / "a", tmp_path / "fil"]):
        for check in (lambda: read_bytes(file, 9), lambda: check_place(file)):
            with pytest.raises(UnusableFileError, match=OUTSIDE):
                check()
        with only_below([tmp_path]):
            assert read_bytes(file, 9) == b"x"
            check_place(file)
    assert read_bytes(file, 9) == b"x"
