"""A table of routes with what each needs and answers, for the app and for its OpenAPI document."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

from fastapi import FastAPI, Path, Query

from semdb.service import schemas
from semdb.service.problems import MEDIA_TYPE, TITLES
from semdb.service.roles import PUBLIC

MapName = Annotated[str, Path(description="name of the map; a slash in it is written %2F", examples=["office"])]
KeyframeId = Annotated[int, Path(ge=1, le=2**63 - 1, description="id of a keyframe", examples=[1])]
Limit = Annotated[int | None, Query(ge=1, le=1000, description="so many at most")]
AfterId = Annotated[int, Query(ge=0, le=2**63 - 1, description="what comes after this key of an earlier page")]

Endpoint = Callable[..., Any]
_ALWAYS = (400, 408, 413, 422, 429, 503)
_GUARDED = (401, 403)


class Table:
    """Routes of one kind."""

    def __init__(self, tag: str) -> None:
        self._tag = tag
        self._rows: list[dict[str, Any]] = []

    def route(
        self,
        method: str,
        path: str,
        role: str,
        model: Any = None,
        *,
        status: int = 200,
        errors: tuple[int, ...] = (),
        also: Mapping[str, Mapping[str, Any]] | None = None,
        only: Mapping[str, Mapping[str, Any]] | None = None,
        extra: Mapping[str, Any] | None = None,
    ) -> Callable[[Endpoint], Endpoint]:
        """Adds a route. `also` and `only` are media types beside JSON, or instead of it, with their schemas."""

        def add(endpoint: Endpoint) -> Endpoint:
            endpoint.role = role  # type: ignore[attr-defined]
            content: dict[str, Any] = dict(only or also or {})
            codes = {*_ALWAYS, *errors, *(() if role == PUBLIC else _GUARDED)}
            if "{" in path:
                codes.add(404)
            answer: dict[str, Any] = {"description": "Done"} | ({"model": model} if model is not None else {})
            if content:
                answer["content"] = content
            self._rows.append(
                {
                    "path": path,
                    "endpoint": endpoint,
                    "methods": [method],
                    "status_code": status,
                    "tags": [self._tag],
                    "summary": (endpoint.__doc__ or "").partition("\n")[0].rstrip("."),
                    "description": (endpoint.__doc__ or "").strip() + ("" if role == PUBLIC else f"\n\nRole: {role}."),
                    "responses": {status: answer} | {code: _problem(code) for code in sorted(codes)},
                    "openapi_extra": {
                        "x-role": role,
                        "security": [] if role == PUBLIC else [{}, {"bearer": []}],
                        **(extra or {}),
                    },
                    "operation_id": endpoint.__name__,
                }
            )
            return endpoint

        return add

    def add_to(self, app: FastAPI) -> None:
        """Adds all of them."""
        for row in self._rows:
            app.add_api_route(**row)


def _problem(code: int) -> dict[str, Any]:
    schema = {"$ref": f"#/components/schemas/{schemas.Problem.__name__}"}
    content: dict[str, Any] = {MEDIA_TYPE: {"schema": schema}}
    if code == 400:  # of what is no HTTP the web server says so itself
        content["text/plain"] = {"schema": {"type": "string"}}
    return {"description": TITLES.get(code, "Error"), "content": content}
