"""Where a recording is: a folder, or an address of a file system that fsspec knows, and how it is written down.

An address (``s3://bucket/room``, ``memory://room``, ``file:///data/room``) is copied file by file into the cache folder
before it is read; files that are there with the right size are not fetched again.
"""

from __future__ import annotations

import hashlib
import os
import re
import secrets
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from semdb.errors import RecordingError, RecordingUnavailableError, UsageError
from semdb.files import only_below
from semdb.names import path_text, written
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.recordings.cameras import parse_camera
from semdb.recordings.credentials import refuse_credentials
from semdb.recordings.options import AS_THE_FORMAT_SAYS, ReadOptions, read_options, write_options
from semdb.recordings.roots import check_root, places_of
from semdb.settings import Settings
from semdb.types import Camera

_ADDRESS = re.compile(r"[a-z][a-z0-9+.-]*://")
_SAID = re.compile(rf"\?(?:camera|{'|'.join(field.name for field in fields(ReadOptions))})=")  # in a source
FETCHERS = 8  # files that are fetched at a time
BLOCK = 1 << 22  # bytes of a file that are in memory at a time
_PROTOCOLS = """
abfs abfss az file ftp gcs git github gist gs hdfs hf http https local memory oci oss s3 s3a sftp smb ssh tar webdav
webhdfs zip
"""
PROTOCOLS = frozenset(_PROTOCOLS.split())
_BARE_PROTOCOL = re.compile(r"[a-z]+")  # as fsspec reads it


def is_address(path: str) -> bool:
    """Whether `path` is a URL, not a folder of this machine."""
    return _ADDRESS.match(path) is not None


@dataclass(frozen=True, slots=True)
class Source:
    """Where a recording is, and what was said by hand about how it is to be read: what it takes to open it again."""

    address: str  # folder, file or URL
    camera: str | None = None  # the text of --camera
    options: ReadOptions = AS_THE_FORMAT_SAYS

    @property
    def parsed_camera(self) -> Camera | None:
        """The camera that was given by hand."""
        return None if self.camera is None else parse_camera(self.camera)


def write_source(address: str, camera: str | None, options: ReadOptions | None = None) -> str:
    """What the database keeps: the absolute path or the URL, and the camera and the options that were given by hand.

    Bytes of the path that are no UTF-8 are written as `semdb.names` has it.
    Raises UsageError for a URL with a password.
    """
    refuse_credentials(address)
    where = written(address if is_address(address) else str(Path(address).absolute()))
    said = [] if camera is None else [f"camera={camera}"]
    if text := write_options(options or ReadOptions()):
        said.append(text)
    return f"{where}?{'&'.join(said)}" if said else where


def parse_source(source: str) -> Source:
    """What `write_source` wrote."""
    found = _SAID.search(source)
    if found is None:
        return Source(path_text(source))
    said, camera = source[found.start() + 1 :], None
    if said.startswith("camera="):
        camera, _, said = said.removeprefix("camera=").partition("&")
    return Source(path_text(source[: found.start()]), camera, read_options(said))


def open_located(
    folder: Path, settings: Settings, camera: Camera | None = None, options: ReadOptions | None = None
) -> list[Recording]:
    """The recordings of what `locate` gave, of files that lie where recordings may lie, and no others.

    Raises what `open_recordings` raises.
    """
    with only_below(places_of(settings.roots, _copies(settings))):
        return open_recordings(folder, camera, options)


def locate(address: str, settings: Settings) -> Path:
    """The folder on this machine: `address` itself, or the copy of a URL, brought up to date.

    Raises UsageError for a URL with a password, for what is not below SEMDB_RECORDING_ROOTS, or where fsspec, or what
    it needs for this kind of URL, is not installed, RecordingError for a URL with nothing under it,
    RecordingUnavailableError when it cannot be reached.
    """
    refuse_credentials(address)
    check_root(address, settings.roots)
    if not is_address(address):
        return Path(address)
    return fetch(address, _copies(settings))


def _copies(settings: Settings) -> Path:
    return settings.cache_dir.expanduser() / "recordings"


def fetch(address: str, cache: Path) -> Path:
    """Copies all files under the URL `address`, or that file, into `cache`. Returns where it is; see `locate`."""
    system, root = _file_system(address)
    try:
        listing = system.find(root, detail=True)
    except FileNotFoundError as error:
        raise RecordingError(f"{address}: there is nothing there") from error
    except Exception as error:  # each file system has errors of its own
        raise _unavailable(address, error) from error
    if not listing:
        raise RecordingError(f"{address}: there is nothing there")
    name = address.rstrip("/").rsplit("/", 1)[-1] or "recording"
    folder = cache / hashlib.sha256(address.rstrip("/").encode(errors="surrogateescape")).hexdigest()[:16] / name
    prefix = str(root).rstrip("/") + "/"
    wanted = []
    for remote, info in listing.items():
        # a single file becomes one of that name
        relative = "" if str(remote) == prefix.rstrip("/") else str(remote).removeprefix(prefix)
        target = folder / relative
        if not target.resolve().is_relative_to(folder.resolve()):
            raise RecordingError(f"{address}: has a file of the impossible name {relative!r}")
        if _is_file(str(remote), info) and not _is_there(target, info):
            wanted.append((str(remote), target, info.get("size")))
    try:
        with ThreadPoolExecutor(FETCHERS) as pool:
            for done in [pool.submit(_fetch_file, system, *one) for one in wanted]:
                done.result()
    except Exception as error:
        raise _unavailable(address, error) from error
    return folder


def _file_system(address: str) -> tuple[Any, str]:
    check_protocols(address)
    try:
        import fsspec
    except ImportError as error:
        raise UsageError(f"{address}: URLs need the remote extra: pip install 'semdb[remote]'") from error
    try:
        system, root = fsspec.core.url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise UsageError(f"{address}: {error}") from error
    except Exception as error:
        raise _unavailable(address, error) from error
    return system, str(root)


def check_protocols(address: str) -> None:
    """Raises UsageError for a URL, or one in a chain (``zip://room::s3://bucket/a.zip``), that is not of `PROTOCOLS`.

    fsspec has file systems that are programs in disguise: their files are templates, pickles or addresses of others.
    """
    for part in address.split("::"):
        protocol, found, _ = part.partition("://")
        if not found and not _BARE_PROTOCOL.fullmatch(part):
            continue  # a path of this machine
        if protocol not in PROTOCOLS:
            raise UsageError(
                f"{address}: recordings are not fetched by {protocol}://; by {', '.join(sorted(PROTOCOLS))} they are"
            )


def _is_file(remote: str, info: dict[str, Any]) -> bool:
    """Whether it is a regular file, or a link of this machine to one."""
    if info.get("islink"):
        return Path(remote).is_file()
    return bool(info.get("type", "file") == "file")


def _is_there(target: Path, info: dict[str, Any]) -> bool:
    """A copy of the same size. Lists are small and may grow or change in place: they are always fetched."""
    if target.suffix.lower() not in (".png", ".jpg", ".jpeg") or not target.is_file():
        return False
    return target.stat().st_size == info.get("size")


def _fetch_file(system: Any, remote: str, target: Path, size: int | None) -> None:
    """Copies a file block by block. Raises OSError for one that has more than the `size` that was listed."""
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".{target.name}.{os.getpid()}.{secrets.token_hex(4)}")
    try:
        with system.open(remote, "rb") as source, part.open("wb") as copy:
            while block := source.read(BLOCK):
                copy.write(block)
                if size is not None and copy.tell() > size:
                    raise OSError(f"{remote} has more than the {size} bytes that are listed")
        part.replace(target)  # whole, or not at all: several workers may fetch it
    finally:
        part.unlink(missing_ok=True)


def _unavailable(address: str, error: Exception) -> RecordingUnavailableError:
    return RecordingUnavailableError(f"{address}: cannot be read now ({type(error).__name__}: {error})")
