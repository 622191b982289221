"""What answers about what is ingested look like, for the OpenAPI document."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from semdb.service.schemas import Model


class JobModel(Model):
    """A job: `waiting`, `running`, `working` (workers have it), `done` or `failed`."""

    job: int
    address: str = Field(examples=["/v1/jobs/1"])
    map: str
    name: str = Field(description="of the recording")
    state: str = Field(examples=["running"])
    recordings: list[dict[str, Any]]
    items: dict[str, int] | None = Field(description="keyframes by their state", examples=[{"done": 4, "pending": 2}])
    progress: dict[str, Any] | None = Field(examples=[{"what": "ingesting room", "done": 4, "total": 6}])
    error: str | None
    attempts: int
    created_at: str
    finished_at: str | None


class Source(Model):
    """What may be ingested: its `path` below one of the folders that are set."""

    path: str = Field(examples=["rgbd_dataset_freiburg1_desk"])
    kind: Literal["folder", "file"]
    bytes: int | None


class Sources(Model):
    """What may be ingested by path. `paths`: whether any folder is set."""

    paths: bool
    entries: list[Source]
    truncated: bool


class Failure(Model):
    """A keyframe that could not be stored."""

    frame_index: int
    attempts: int
    error: str


class Failures(Model):
    """What could not be stored of a recording."""

    map: str
    recording: str
    failures: list[Failure]
    next: str | None = Field(description="address of the next page; null at the end")
    key: str | None = Field(description="key of the last one, where more follow")


class UploadModel(Model):
    """Files that came: `upload` is what `ingest` takes."""

    upload: str
    name: str
    bytes: int
