"""The explorer: a page for people, built from web/ into page/, that asks the same routes as every client."""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request
from starlette.responses import Response

from semdb.service.answers import ASK_AGAIN
from semdb.service.problems import not_found
from semdb.service.roles import PUBLIC

FOLDER = Path(__file__).parent / "page"
NOT_OF_THE_PAGE = ("/v1", "/health", "/ready", "/metrics", "/page")
FOR_EVER = "public, max-age=31536000, immutable"
_MEDIA = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".LICENSE": "text/plain; charset=utf-8",
}
_SMALL = 512  # bytes that are not worth compressing


@dataclass(frozen=True, slots=True)
class Asset:
    """A file of the page: its bytes, the same compressed where that is less, and what it is."""

    content: bytes
    compressed: bytes | None
    media_type: str
    tag: str


@dataclass(frozen=True, slots=True)
class Page:
    """All files. `build` tells one build from another: it is in every address but that of the page itself."""

    build: str
    files: dict[str, Asset]


@cache
def load_page() -> Page:
    """The files of the installed page, read once."""
    raw = {file.name: file.read_bytes() for file in sorted(FOLDER.iterdir()) if file.suffix in _MEDIA}
    digest = hashlib.sha256()
    for name, content in raw.items():
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    build = digest.hexdigest()[:16]
    raw["index.html"] = raw["index.html"].replace(b"/page/BUILD/", f"/page/{build}/".encode())
    return Page(build, {name: _asset(name, content) for name, content in raw.items()})


def _asset(name: str, content: bytes) -> Asset:
    compressed = gzip.compress(content, 9, mtime=0) if len(content) > _SMALL else None
    tag = f'"{hashlib.sha256(content).hexdigest()[:32]}"'
    return Asset(content, compressed, _MEDIA[Path(name).suffix], tag)


def is_of_the_page(request: Request) -> bool:
    """Whether someone with a browser asks for an address that the page, not the service, makes something of."""
    path = request.scope["path"]
    wanted = "text/html" in request.headers.get("accept", "")
    of_service = any(path == start or path.startswith(f"{start}/") for start in NOT_OF_THE_PAGE)
    return request.method in ("GET", "HEAD") and wanted and not of_service


async def get_page(request: Request) -> Response:
    """The page for people, whatever state of it the address names."""
    return _sent(request, load_page().files["index.html"], ASK_AGAIN)


async def get_file(request: Request, build: str, name: str) -> Response:
    """A file of the page. Under the name of its build it never changes."""
    page = load_page()
    found = page.files.get(name)
    if build != page.build or found is None or name == "index.html":
        raise not_found("file of the page: it is of another version, load the page again")
    return _sent(request, found, FOR_EVER)


def _sent(request: Request, asset: Asset, cache_control: str) -> Response:
    headers = {"ETag": asset.tag, "Cache-Control": cache_control, "Vary": "Accept-Encoding"}
    known = [one.strip().removeprefix("W/") for one in request.headers.get("if-none-match", "").split(",")]
    if asset.tag in known:
        return Response(None, 304, headers)
    encodings = [one.partition(";")[0].strip() for one in request.headers.get("accept-encoding", "").split(",")]
    if asset.compressed is not None and "gzip" in encodings:
        return Response(asset.compressed, 200, headers | {"Content-Encoding": "gzip"}, asset.media_type)
    return Response(asset.content, 200, headers, asset.media_type)


def add_page(app: FastAPI) -> None:
    """Adds the page to the routes; it is none for programs, so it is not in their document."""
    endpoints: dict[str, Any] = {"/": get_page, "/page/{build}/{name}": get_file}
    for path, endpoint in endpoints.items():
        endpoint.role = PUBLIC
        app.add_api_route(path, endpoint, methods=["GET"], include_in_schema=False)
