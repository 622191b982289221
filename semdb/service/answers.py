"""How answers are sent: JSON without NaN, pages of lists, things that never change."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar
from urllib.parse import urlencode

from starlette.requests import Request
from starlette.responses import Response

from semdb.jsonable import to_jsonable

T = TypeVar("T")
_YEAR_S = 31_536_000
FOR_EVER = f"private, max-age={_YEAR_S}, immutable"
ASK_AGAIN = "private, no-cache"


def encoded(content: Any) -> bytes:
    """A JSON document: what JSON cannot hold is null, everything else is exact."""
    return json.dumps(to_jsonable(content), ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode(
        "utf-8", "backslashreplace"
    )


def as_json(content: Any, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    """`content` as JSON."""
    return Response(encoded(content), status, headers, "application/json")


def tag_of(content: bytes) -> str:
    """The ETag of what is told by `content`: the bytes of an answer, or all that makes them."""
    return f'"{hashlib.sha256(content).hexdigest()[:32]}"'


def has(request: Request, tag: str) -> bool:
    """Whether the client says that it has what has this ETag."""
    known = [one.strip().removeprefix("W/") for one in request.headers.get("if-none-match", "").split(",")]
    return tag in known or "*" in known


def tagged(
    request: Request,
    content: bytes,
    media_type: str,
    *,
    for_ever: bool,
    headers: dict[str, str] | None = None,
    tag: str | None = None,
) -> Response:
    """`content` with its ETag, or 304 where the client has it. `for_ever`: it never changes under its address."""
    tag = tag or tag_of(content)
    all_headers = {
        "ETag": tag,
        "Cache-Control": FOR_EVER if for_ever else ASK_AGAIN,
        "Vary": "Authorization",  # what a browser kept for one token is not for whoever comes with another
        **(headers or {}),
    }
    if has(request, tag):
        return Response(None, 304, all_headers)
    return Response(content, 200, all_headers, media_type)


def page_of(
    request: Request,
    items: Sequence[T],
    limit: int,
    key: Callable[[T], object],
    shown: Callable[[T], Any],
    *,
    by: str = "after",
    under: str = "items",
    also: Mapping[str, Any] | None = None,
) -> Response:
    """The first `limit` of `items`, which are one more where there are more, and the address of what follows.

    They are `under` that name, beside what the answer has `also`.
    """
    more = len(items) > limit
    items = items[:limit]
    last = str(key(items[-1])) if more and items else None
    shown_items = [shown(item) for item in items]
    return as_json({**(also or {}), under: shown_items, "next": _next(request, by, last), "key": last})


def _next(request: Request, name: str, key: str | None) -> str | None:
    if key is None:
        return None
    given = [(k, v) for k, v in request.query_params.multi_items() if k != name]
    return f"{request.scope['raw_path'].decode('ascii')}?{urlencode([*given, (name, key)])}"
