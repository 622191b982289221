"""What a service says went wrong, as the errors that the library raises for the same."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from semdb.errors import (
    DatabaseError,
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

if TYPE_CHECKING:
    import httpx

PREFIX = "urn:semdb:problem:"
_BY_KIND: dict[str, type[SemdbError]] = {
    "frame": FrameError,
    "recording": RecordingError,
    "other-models": ProvenanceError,
    "model": ModelError,
    "schema": SchemaError,
    "statement": DatabaseError,
}
_BY_STATUS: dict[int, type[SemdbError]] = {
    401: DatabaseError,
    403: DatabaseError,
    404: NotFoundError,
    408: DatabaseUnavailableError,
    409: DatabaseError,
    413: FrameError,
    422: UsageError,
    429: DatabaseUnavailableError,
    501: UsageError,
    502: DatabaseUnavailableError,
    503: DatabaseUnavailableError,
    504: DatabaseUnavailableError,
    507: DatabaseUnavailableError,
}
_HINTS = {401: "give a token: token=, or SEMDB_TOKEN, or a file of SEMDB_TOKEN_FILE"}


def document_of(response: httpx.Response) -> dict[str, Any]:
    """The members of a problem; nothing where the answer is none, as that of a proxy."""
    try:
        found = response.json()
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def kind_of(response: httpx.Response) -> str:
    """The last part of the type of a problem."""
    return str(document_of(response).get("type", "")).removeprefix(PREFIX)


def error_of(response: httpx.Response, server: str) -> SemdbError:
    """The error that an answer stands for, a child of `SemdbError`."""
    status = response.status_code
    said = document_of(response).get("detail")
    text = for_terminal(said) if isinstance(said, str) else f"it answered {status} and no problem document"
    if status in _HINTS:
        text = f"{text}; {_HINTS[status]}"
    kind = _BY_KIND.get(kind_of(response)) or _BY_STATUS.get(status, DatabaseError)
    return kind(f"{server}: {text}")
