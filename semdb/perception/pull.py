"""Weights from their publishers: downloaded, resumed, checked, kept in the models folder. The only network access."""

from __future__ import annotations

import errno
import json
import os
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPException, HTTPResponse
from pathlib import Path

from semdb.errors import ModelError
from semdb.perception.catalogue import Published
from semdb.perception.model_files import file_sha256

Progress = Callable[[int, int], None]  # bytes, bytes in all (0: not known)
RECORD = "sha256.json"
"""In the models folder: the hashes of files whose publisher gives none, as first pulled."""

_CHUNK = 1 << 18
_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class Pulled:
    """`path` has `sha256`; `fetched` False when it was there before, `recorded` True when its hash is new."""

    path: Path
    sha256: str
    fetched: bool
    recorded: bool


def pull(model: Published, folder: Path, progress: Progress | None = None) -> Pulled:
    """The file of `model` in `folder`, downloaded unless it is there, its hash checked.

    A download that broke off is resumed from ``FILE.part``. Raises ModelError when it cannot be had (no network, no
    room on the disk, an answer that is no file) or is not the file that it should be; nothing wrong is left as FILE.
    """
    path = folder / model.file
    fetched = not path.is_file()
    if fetched:
        part = path.with_name(path.name + ".part")
        try:
            folder.mkdir(parents=True, exist_ok=True)
            _download(model, part, path, progress)
        except OSError as error:
            raise _as_model_error(error, model, path, part) from error
        except HTTPException as error:
            raise ModelError(
                f"{model.url}: the connection broke off ({error!r}); run the command again: it goes on from there"
            ) from error
    sha256 = file_sha256(path if not fetched else part)
    recorded = _check(model, folder, path, part if fetched else path, sha256)
    if fetched:
        part.replace(path)
    return Pulled(path, sha256, fetched, recorded)


def recorded_hashes(folder: Path) -> dict[str, str]:
    """File name to SHA-256 as recorded by first pulls. Raises ModelError when the record cannot be read."""
    record = folder / RECORD
    try:
        content = json.loads(record.read_text())
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise ModelError(f"{record} cannot be read ({error}): delete it to record hashes anew") from error
    if not isinstance(content, dict):
        raise ModelError(f"{record} is not a JSON object: delete it to record hashes anew")
    return {str(name): str(value) for name, value in content.items()}


def _download(model: Published, part: Path, path: Path, progress: Progress | None) -> None:
    have = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(model.url, headers={"User-Agent": "semdb"})
    if have:
        request.add_header("Range", f"bytes={have}-")
    try:
        answer = urllib.request.urlopen(request, timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # all of it was there already, or what is there is no beginning of it
            if error.headers.get("Content-Range", "").rpartition("/")[2] == str(have):
                return
            part.unlink()
            _download(model, part, path, progress)
            return
        raise ModelError(
            f"{model.url} answers {error.code} {error.reason}: the publisher may have moved it; put the file "
            f"{model.file} into {path.parent} by hand"
        ) from error
    with answer:
        _receive(answer, model, part, have if answer.status == 206 else 0, progress)


def _receive(answer: HTTPResponse, model: Published, part: Path, start: int, progress: Progress | None) -> None:
    """Writes the body of `answer` at `start` of `part`; what came before a break stays for the next try."""
    length = answer.headers.get("Content-Length")
    total = start + int(length) if length else 0
    with part.open("r+b" if start else "wb") as file:
        file.seek(start)
        done = start
        if progress is not None:
            progress(done, total)
        while chunk := answer.read(_CHUNK):
            file.write(chunk)
            done += len(chunk)
            if progress is not None:
                progress(done, total)
    if total and done < total:
        raise ModelError(
            f"{model.url}: the connection broke off after {done} of {total} bytes; run the command again: it goes on "
            "from there"
        )


def _check(model: Published, folder: Path, path: Path, file: Path, sha256: str) -> bool:
    """Whether the hash was recorded just now. Raises ModelError when it is not the one that it should be."""
    if model.sha256:
        expected, source = model.sha256, "its publisher's"
    else:
        expected, source = recorded_hashes(folder).get(model.file, ""), f"the one recorded in {folder / RECORD}"
    if expected and not sha256.startswith(expected):
        what = f"{model.url} sent a file" if file != path else f"{path} is a file"
        if file != path:
            file.unlink()
        raise ModelError(
            f"{what} with the SHA-256 {sha256[:16]}…, but {source} is {expected[:16]}: it is damaged or another file"
            + ("; it was not kept" if file != path else "; delete it and pull it again")
        )
    if not expected:
        _record(folder, model.file, sha256)
    return not expected


def _record(folder: Path, name: str, sha256: str) -> None:
    record = folder / RECORD
    new = record.with_name(f"{RECORD}.{os.getpid()}")
    new.write_text(json.dumps({**recorded_hashes(folder), name: sha256}, indent=2, sort_keys=True) + "\n")
    new.replace(record)


def _as_model_error(error: OSError, model: Published, path: Path, part: Path) -> ModelError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ModelError(
            f"no room on the disk of {part.parent} for {model.file} ({model.megabytes} MB): make room and run the "
            "command again (it goes on from there), or set SEMDB_CACHE_DIR to another disk"
        )
    reason = getattr(error, "reason", error)
    if isinstance(error, (urllib.error.URLError, TimeoutError, ConnectionError, ssl.SSLError)):
        return ModelError(
            f"{model.url} cannot be reached ({reason}): without network access, fetch it on another machine and put "
            f"it there as {path}" + ("; what came so far is kept" if part.is_file() else "")
        )
    return ModelError(f"{error.filename or part}: {error.strerror or error}")
