"""Errors as problem JSON (RFC 9457): what is wrong and what to do, and nothing of the machine behind."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from semdb.errors import (
    DatabaseUnavailableError,
    FrameError,
    ModelError,
    NotFoundError,
    ProvenanceError,
    RecordingError,
    SchemaError,
    SemdbError,
    UsageError,
)
from semdb.shown import for_terminal

MEDIA_TYPE = "application/problem+json"
LONGEST = 600
TITLES = {
    400: "Bad request",
    401: "No valid token",
    403: "Not allowed",
    404: "Not found",
    405: "Method not allowed",
    406: "Not acceptable",
    408: "Too slow",
    409: "Conflict",
    411: "Length required",
    413: "Too large",
    415: "Unsupported media type",
    422: "Cannot be used",
    428: "Confirmation needed",
    429: "Busy",
    499: "Client went away",
    500: "Internal error",
    501: "Not set up",
    503: "Not available",
    507: "No room",
}
_CANNOT_BE_USED: dict[type[SemdbError], str] = {FrameError: "frame", RecordingError: "recording", UsageError: "usage"}
_IN_DATABASE = re.compile(r" (?:in|of) \w+(?:\+\w+)?://\S*")
_URL = re.compile(r"\w+(?:\+\w+)?://[^\s'\"]*")
_PATH = re.compile(r"(?<![\w.>])(?:~|\.{1,2})?/(?:[^\s/:;,'\"()]+/)*[^\s/:;,'\"()]+/?")
_LISTED = re.compile(r"; (?:maps|recordings): .*", re.DOTALL)


@dataclass(eq=False)
class Problem(Exception):  # noqa: N818 (RFC 9457 calls it so)
    """An error that a client is told. `detail` names no path, URL or stack."""

    status: int
    detail: str
    kind: str = ""  # the last part of its type
    headers: Mapping[str, str] = field(default_factory=dict)
    more: Mapping[str, Any] = field(default_factory=dict)

    def as_dict(self, request_id: str = "") -> dict[str, Any]:
        """The members of the document."""
        kind = self.kind or TITLES.get(self.status, "error").lower().replace(" ", "-")
        return {
            "type": f"urn:semdb:problem:{kind}",
            "title": TITLES.get(self.status, "Error"),
            "status": self.status,
            "detail": self.detail,
            "request_id": request_id,
            **self.more,
        }

    def body(self, request_id: str = "") -> bytes:
        """The document."""
        return json.dumps(self.as_dict(request_id), default=str).encode()


def busy(what: str, seconds: float) -> Problem:
    """Too much is asked at the moment."""
    wait = str(max(1, round(seconds)))
    return Problem(429, f"{what}: come again in {wait} s", headers={"Retry-After": wait})


def not_found(what: str) -> Problem:
    """What is not there, or is not for this token."""
    return Problem(404, f"there is no {what}")


def scrubbed(text: object) -> str:
    """A message of the library without URLs and absolute paths, and without what else the database holds."""
    plain = _LISTED.sub("", for_terminal(text))
    plain = _PATH.sub("...", _URL.sub("...", _IN_DATABASE.sub("", plain)))
    return plain if len(plain) <= LONGEST else f"{plain[:LONGEST]}..."


def problem_of(error: SemdbError) -> Problem:
    """What a client is told of an error of the library."""
    if isinstance(error, NotFoundError):
        return Problem(404, scrubbed(error))
    for cause, kind in _CANNOT_BE_USED.items():
        if isinstance(error, cause):
            return Problem(422, scrubbed(error), kind=kind)
    if isinstance(error, ProvenanceError):
        return Problem(409, scrubbed(error), kind="other-models")
    if isinstance(error, ModelError):
        return Problem(503, "a model that the map needs is not there or does not work", kind="model")
    if isinstance(error, SchemaError):
        return Problem(503, "the schema of the database is missing, older or newer", kind="schema")
    if isinstance(error, DatabaseUnavailableError):
        return Problem(503, "the database does not answer now", kind="database", headers={"Retry-After": "2"})
    return Problem(500, "what is stored of this cannot be read, or the database refused it", kind="database-refused")
