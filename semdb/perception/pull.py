"""Weights from their publishers: downloaded, resumed, checked, kept in the models folder. The only network access."""

from __future__ import annotations

import errno
import ipaddress
import json
import os
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from http.client import HTTPException, HTTPMessage, HTTPResponse
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from semdb.errors import ModelError
from semdb.files import MissingFileError, UnusableFileError, megabytes, read_json
from semdb.perception.catalogue import Published
from semdb.perception.model_files import file_sha256

Progress = Callable[[int, int], None]  # bytes, bytes in all (0: not known)
RECORD = "sha256.json"
"""In the models folder: the hashes of files whose publisher gives none, as first pulled."""

_CHUNK = 1 << 18
_SPARE_BYTES = 1 << 24  # a file may be so much larger than twice what is known of it
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
        _check_way(model.url, model, path)
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
        content = read_json(record)
    except MissingFileError:
        return {}
    except UnusableFileError as error:
        raise ModelError(f"{record} cannot be read ({error}): delete it to record hashes anew") from error
    if not isinstance(content, dict):
        raise ModelError(f"{record} is not a JSON object: delete it to record hashes anew")
    return {str(name): str(value) for name, value in content.items()}


def most_bytes(model: Published) -> int:
    """How large the file of `model` may be: what is more is none."""
    return 2 * model.megabytes * 1_000_000 + _SPARE_BYTES


def _check_way(url: str, model: Published, path: Path) -> None:
    """Raises ModelError where whoever is on the way could send another file, and nothing would tell."""
    parsed = urlsplit(url)
    if parsed.scheme == "https" or (parsed.scheme == "http" and (model.sha256 or _is_this_machine(parsed.hostname))):
        return
    if parsed.scheme != "http":
        raise ModelError(f"{model.url} leads to {url}, which is not fetched: only https and http are")
    raise ModelError(
        f"{url} is not encrypted, and no hash of {model.file} is published: anybody on the way, or the login page of a "
        f"network, could take its place. Fetch it where you trust the network and put it there as {path}, or name the "
        f"hash that it must have: semdb models pull {model.name} --sha256 HEX"
    )


def _is_this_machine(host: str | None) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host or "").is_loopback
    except ValueError:
        return False


class _Redirects(urllib.request.HTTPRedirectHandler):
    """Follows redirections to where `_check_way` lets it."""

    def __init__(self, model: Published, path: Path) -> None:
        self._model, self._path = model, path

    def redirect_request(
        self, req: urllib.request.Request, fp: Any, code: int, msg: str, headers: HTTPMessage, newurl: str
    ) -> urllib.request.Request | None:
        _check_way(newurl, self._model, self._path)
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _download(model: Published, part: Path, path: Path, progress: Progress | None) -> None:
    have = part.stat().st_size if part.is_file() else 0
    if have > most_bytes(model):
        part.unlink()
        have = 0
    request = urllib.request.Request(model.url, headers={"User-Agent": "semdb"})
    if have:
        request.add_header("Range", f"bytes={have}-")
    try:
        answer = urllib.request.build_opener(_Redirects(model, path)).open(request, timeout=_TIMEOUT_S)
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
    total = start + int(length) if length and length.isdecimal() else 0
    most = most_bytes(model)
    if total > most:
        raise _too_large(model, part, total)
    with part.open("r+b" if start else "wb") as file:
        file.seek(start)
        done = start
        if progress is not None:
            progress(done, total)
        while chunk := answer.read(_CHUNK):
            done += len(chunk)
            if done > most:
                raise _too_large(model, part, done)
            file.write(chunk)
            if progress is not None:
                progress(done, total)
    if total and done < total:
        raise ModelError(
            f"{model.url}: the connection broke off after {done} of {total} bytes; run the command again: it goes on "
            "from there"
        )


def _too_large(model: Published, part: Path, size: int) -> ModelError:
    part.unlink(missing_ok=True)
    return ModelError(
        f"{model.url} sends {megabytes(size)} or more, but {model.file} has {model.megabytes} MB: that is another "
        "file; nothing was kept"
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
    if not expected and file != path and file.open("rb").read(256).lstrip().startswith(b"<"):
        file.unlink()
        raise ModelError(f"{model.url} sent a page, not a file of weights; nothing was kept")
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
