"""What workers do. Task names are part of the interface: senders know them, not this module."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from . import INGEST_TASK, app


@app.task(name=INGEST_TASK)  # type: ignore[untyped-decorator]
def ingest_recording(
    path: str, map_name: str | None = None, name: str | None = None, options: Mapping[str, Any] | None = None
) -> list[dict[str, Any]]:
    """Ingest the recording at `path`, which the worker must see under that path.

    `options` are those of `semdb.ingest.ingest_recordings`: keyframes, stride, camera. Returns its summaries.
    Raises `SemdbError`, which Celery logs with the task; running the task again goes on where it stopped.
    """
    from pathlib import Path

    from semdb.ingest import ingest_recordings
    from semdb.settings import Settings

    summaries = ingest_recordings([Path(path)], Settings(), map_name=map_name, name=name, **dict(options or {}))
    return [asdict(summary) for summary in summaries]
