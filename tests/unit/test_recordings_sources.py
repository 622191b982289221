"""Recordings behind URLs: which kinds are taken, and that nothing large or strange is read into memory."""

from __future__ import annotations

import io
import json
import os
import threading
from pathlib import Path
from typing import Any

import fsspec
import pytest

from semdb.errors import RecordingUnavailableError, UsageError
from semdb.recordings import source
from semdb.recordings.source import BLOCK, check_protocols, fetch


@pytest.mark.parametrize(
    "address",
    [
        "reference://room",
        "reference://::memory://refs.json",
        "zip://room::reference://x",
        "simplecache::s3://bucket/room",
        "filecache::https://host/room",
        "blockcache://room",
        "dask://room",
        "jupyter://host/room",
        "pyfilesystem://room",
        "no-such-system://room",
    ],
)
def test_file_systems_that_run_what_they_read_are_refused(address: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"recordings are not fetched by [a-z-]+://; by abfs"):
        fetch(address, tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "address",
    ["s3://bucket/room", "zip://room::s3://bucket/a.zip", "zip://room::/data/a.zip", "zip://room::a.zip", "memory://a"],
)
def test_others_are_taken(address: str) -> None:
    check_protocols(address)


def test_a_reference_with_a_template_is_not_rendered(tmp_path: Path) -> None:
    marker = tmp_path / "marker"
    code = "{{ self.__init__.__globals__.__builtins__.open('%s', 'w') }}" % marker  # noqa: UP031
    refs = {"version": 1, "templates": {"u": code}, "refs": {"rgb.txt": ["{{u}}", 0, 1]}}
    fsspec.filesystem("memory").pipe("/refs.json", json.dumps(refs).encode())
    with pytest.raises(UsageError):
        fetch("reference://::memory://refs.json", tmp_path / "cache")
    assert not marker.exists()


class _Large(io.RawIOBase):
    """A file of `size` bytes, read in blocks; `asked` are their sizes."""

    def __init__(self, size: int, asked: list[int]) -> None:
        self.left, self.asked = size, asked

    def read(self, count: int = -1) -> bytes:
        assert count > 0
        self.asked.append(count)
        count = min(count, self.left)
        self.left -= count
        return bytes(count)


class _System:
    def __init__(self, size: int, listed: int | None) -> None:
        self.size, self.listed = size, listed
        self.asked: list[int] = []

    def find(self, root: str, detail: bool) -> dict[str, dict[str, Any]]:
        return {f"{root}/a.bag": {"type": "file", "size": self.listed}}

    def open(self, remote: str, mode: str) -> _Large:
        return _Large(self.size, self.asked)


def test_files_are_copied_block_by_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    system = _System(3 * BLOCK + 5, 3 * BLOCK + 5)
    monkeypatch.setattr(source, "_file_system", lambda address: (system, "/room"))
    folder = fetch("s3://bucket/room", tmp_path)
    assert (folder / "a.bag").stat().st_size == 3 * BLOCK + 5
    assert set(system.asked) == {BLOCK}


def test_a_file_that_never_ends_is_left_and_nothing_of_it_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source, "_file_system", lambda address: (_System(1 << 60, 100), "/room"))
    with pytest.raises(RecordingUnavailableError, match="has more than the 100 bytes that are listed"):
        fetch("s3://bucket/room", tmp_path)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_pipes_and_devices_behind_a_file_url_are_passed_over(tmp_path: Path) -> None:
    room = tmp_path / "room"
    room.mkdir()
    (room / "rgb.txt").write_text("1 a.png\n")
    (room / "link.txt").symlink_to(room / "rgb.txt")
    os.mkfifo(room / "pipe")
    (room / "zero.png").symlink_to("/dev/zero")
    found: list[Path] = []
    thread = threading.Thread(target=lambda: found.append(fetch(f"file://{room}", tmp_path / "cache")), daemon=True)
    thread.start()
    thread.join(30)
    assert not thread.is_alive()
    assert sorted(path.name for path in found[0].iterdir()) == ["link.txt", "rgb.txt"]
