"""What workers do. Task names are part of the interface: senders know them, not this module."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from . import INGEST_TASK, app


@app.task(name=INGEST_TASK)  # type: ignore[untyped-decorator]
def ingest_recording(
    path: str, map_name: str | None = None, name: str | None = None, options: Mapping[str, Any] | None = None
) -> list[dict[str, Any]]:
    """Ingest the recording at `path`, which the worker must see under that path.

    `options`: ``keyframes`` and ``stride`` (int), ``camera`` (text as for ``--camera``). Returns what was stored of
    each recording. Raises `SemdbError`, which Celery logs; the task sent again goes on where this one stopped.
    """
    from pathlib import Path

    from semdb.errors import UsageError
    from semdb.ingest import IngestOptions, ingest_recordings
    from semdb.recordings import parse_camera
    from semdb.settings import Settings

    given = dict(options or {})
    unknown = sorted(set(given) - {"keyframes", "stride", "camera"})
    if unknown:
        raise UsageError(f"{INGEST_TASK} has no option {unknown[0]!r}: keyframes, stride, camera")
    if given.get("camera") is not None:
        given["camera"] = parse_camera(given["camera"])
    summaries = ingest_recordings([Path(path)], Settings(), IngestOptions(map_name=map_name, name=name, **given))
    return [
        {
            "map": summary.map_name,
            "recording": summary.recording,
            "planned": summary.planned,
            "already_stored": summary.already_stored,
            "stored": summary.stored,
            "failed": len(summary.failed),
        }
        for summary in summaries
    ]
