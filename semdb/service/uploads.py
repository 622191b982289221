"""Recordings that clients send: files below one folder, each upload in a folder of its own, for some days."""

from __future__ import annotations

import json
import os
import re
import secrets
import shutil
import stat
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semdb.service.problems import Problem, not_found

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
ID = re.compile(r"[0-9a-f]{24}")
MOST_ENTRIES = 200_000
MOST_RATIO = 200  # of what is unpacked to what was sent; images are compressed already
ROOM_LEFT = 2**30  # bytes that stay free on the disk
BLOCK = 2**20
_ABOUT, _CONTENT, _PACKED = "upload.json", "content", "packed"


@dataclass(frozen=True, slots=True)
class Upload:
    """What a client sent. `path` is what can be ingested."""

    id: str
    who: str
    name: str
    folder: Path

    @property
    def content(self) -> Path:
        """Where the recording is."""
        return self.folder / _CONTENT

    @property
    def path(self) -> Path:
        """The recording: the one file or folder in it, or all of it."""
        found = sorted(self.content.iterdir()) if self.content.is_dir() else []
        return found[0] if len(found) == 1 else self.content


class Uploads:
    """The folder of uploads."""

    def __init__(self, folder: Path, most_unpacked: int) -> None:
        self.folder, self._most_unpacked = folder, most_unpacked

    def new(self, who: str, name: str) -> Upload:
        """A folder for what comes. Raises Problem 422 for a name that is none."""
        if not NAME.fullmatch(name):
            raise Problem(422, "a name of an upload is made of A-Z a-z 0-9 . _ -, 100 characters at most")
        self.folder.mkdir(parents=True, exist_ok=True, mode=0o750)
        self.check_room()
        found = Upload(secrets.token_hex(12), who, name, Path())
        folder = self.folder / found.id
        folder.mkdir(parents=True, mode=0o750)
        (folder / _CONTENT).mkdir()
        (folder / _ABOUT).write_text(json.dumps({"who": who, "name": name}), "utf-8")
        return Upload(found.id, who, name, folder)

    def check_room(self) -> None:
        """Raises Problem 507 where the disk is nearly full."""
        if shutil.disk_usage(self.folder).free < ROOM_LEFT:
            raise Problem(507, "there is no room for uploads")

    def find(self, name: str, who: str, *, any_ones: bool = False) -> Upload:
        """The upload of whoever asks. Raises Problem 404."""
        folder = self.folder / name
        if not ID.fullmatch(name) or not (folder / _ABOUT).is_file():
            raise not_found(f"upload {name!r}")
        about = json.loads((folder / _ABOUT).read_text("utf-8"))
        if about["who"] != who and not any_ones:
            raise not_found(f"upload {name!r}")
        return Upload(name, about["who"], about["name"], folder)

    def finish(self, upload: Upload, packed: Path) -> int:
        """Makes what came the content, unpacked where it is a zip. Returns its bytes. Raises Problem 413, 422."""
        if zipfile.is_zipfile(packed):
            size = self._unpack(packed, upload.content)
            packed.unlink()
            return size
        os.replace(packed, upload.content / upload.name)
        return (upload.content / upload.name).stat().st_size

    def _unpack(self, packed: Path, folder: Path) -> int:
        try:
            with zipfile.ZipFile(packed) as archive:
                entries = archive.infolist()
                self._check(entries, packed.stat().st_size)
                room = self._most_unpacked
                for entry in entries:
                    room -= _unpack_one(archive, entry, folder, room)
                return self._most_unpacked - room
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, OSError) as error:
            if isinstance(error, OSError) and error.errno in (28, 122):
                raise Problem(507, "there is no room for it") from error
            raise Problem(422, "the zip is damaged, or of a kind that is not read") from error

    def _check(self, entries: list[zipfile.ZipInfo], sent: int) -> None:
        if len(entries) > MOST_ENTRIES:
            raise Problem(413, f"the zip has {len(entries)} entries, more than {MOST_ENTRIES}")
        total = sum(entry.file_size for entry in entries)
        room = shutil.disk_usage(self.folder).free - ROOM_LEFT
        if total > self._most_unpacked or total > MOST_RATIO * max(sent, 10_000):
            raise Problem(413, "the zip would be too large once it is unpacked")
        if total > room:
            raise Problem(507, "there is no room for it")
        for entry in entries:
            _check_entry(entry)

    def forget(self, older_than_s: float) -> int:
        """Deletes uploads that came longer ago. Returns how many."""
        forgotten = 0
        for folder in self.folder.iterdir() if self.folder.is_dir() else ():
            if ID.fullmatch(folder.name) and time.time() - folder.stat().st_mtime > older_than_s:
                shutil.rmtree(folder, ignore_errors=True)
                forgotten += 1
        return forgotten

    def drop(self, upload: Upload) -> None:
        """Deletes an upload."""
        shutil.rmtree(upload.folder, ignore_errors=True)


def packed_of(upload: Upload) -> Path:
    """Where what comes is written before it is whole."""
    return upload.folder / _PACKED


def _check_entry(entry: zipfile.ZipInfo) -> None:
    """Raises Problem 422 for an entry that would be anywhere else, or is anything but a file or folder."""
    parts = entry.filename.split("/")
    kind = stat.S_IFMT(entry.external_attr >> 16)
    if entry.filename.startswith("/") or ".." in parts or any(c in entry.filename for c in "\\\0:"):
        raise Problem(422, "the zip has an entry that leads out of it")
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise Problem(422, "the zip has an entry that is a link or no file")
    if entry.flag_bits & 1:
        raise Problem(422, "the zip is encrypted")
    if len(entry.filename) > 1000 or any(len(part.encode()) > 255 for part in parts):
        raise Problem(422, "the zip has an entry with a name that is too long")


def _unpack_one(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, folder: Path, room: int) -> int:
    """Writes an entry below `folder`. Returns its bytes; what it says of its size is not believed."""
    target = folder / entry.filename
    if entry.is_dir():
        target.mkdir(parents=True, exist_ok=True)
        return 0
    target.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with archive.open(entry) as source, target.open("xb") as out:
        while block := source.read(BLOCK):
            written += len(block)
            if written > room or written > entry.file_size:
                raise Problem(413, "the zip would be too large once it is unpacked")
            out.write(block)
    return written


def live_frame(upload: Upload, files: dict[str, bytes], said: dict[str, Any]) -> None:
    """Adds a frame to a recording in TUM's layout: colour, depth, and the pose where there is one."""
    folder = upload.content / upload.name
    name = f"{said['timestamp_ns'] // 10**9}.{said['timestamp_ns'] % 10**9:09d}"
    camera = folder / "camera.json"
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True, exist_ok=True)
    if not camera.exists():
        camera.write_text(json.dumps(said["camera"]), "utf-8")
    for kind, ending in (("rgb", said["ending"]), ("depth", "png")):
        if kind in files:
            with (folder / kind / f"{name}.{ending}").open("xb") as file:
                file.write(files[kind])
            _append(folder / f"{kind}.txt", f"{name} {kind}/{name}.{ending}\n")
    if said["pose"] is not None:
        _append(folder / "groundtruth.txt", f"{name} {' '.join(map(repr, said['pose']))}\n")


def _append(file: Path, line: str) -> None:
    with file.open("a", encoding="ascii") as out:  # one small write: lines of several processes do not mix
        out.write(line)
