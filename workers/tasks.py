"""What workers do. Task names are part of the interface: senders know them, not this module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from celery.exceptions import SoftTimeLimitExceeded

from semdb.database import retry
from semdb.errors import SemdbError
from semdb.events import event
from semdb.item_work import log_item
from semdb.queueing import Workplace
from semdb.settings import Settings

from . import HARD_LIMIT_S, INGEST_TASK, ITEMS_TASK, SOFT_LIMIT_S, app, metrics, send_items, stopping

_workplaces: list[Workplace] = []  # of this process, made by its first task


@app.task(name=ITEMS_TASK, bind=True, soft_time_limit=SOFT_LIMIT_S, time_limit=HARD_LIMIT_S, max_retries=None)  # type: ignore[untyped-decorator]
def ingest_items(self: Any, recording_id: int, source: str, frames: Sequence[int]) -> dict[str, int]:
    """Describe and store keyframes `frames` of a planned recording, those that nobody else has.

    What may heal (database gone, mount lost) is tried again with back-off; a frame that cannot be read is `failed`
    in the database and no error here. Returns counts.
    """
    if not _workplaces:
        _workplaces.append(Workplace(Settings()))

    def note(item: Any) -> None:
        metrics.count(item)
        log_item(recording_id, item)

    try:
        outcome = _workplaces[0].do(recording_id, source, frames, stop=stopping.is_set, note=note)
    except (*retry.MAY_HEAL, SoftTimeLimitExceeded) as error:
        delay = retry.task_delay_s(self.request.retries)
        metrics.retried("task")
        event("retry", recording=recording_id, frames=len(frames), seconds=round(delay, 1), error=str(error))
        raise self.retry(exc=error, countdown=delay) from error
    except SemdbError as error:
        event("refused", recording=recording_id, frames=len(frames), error=str(error))
        raise
    if outcome.left:
        send_items(recording_id, source, outcome.left)
    if outcome.complete:
        event("complete", recording=recording_id)
    return {"stored": outcome.stored, "failed": len(outcome.failed), "lost": outcome.lost, "left": len(outcome.left)}


@app.task(name=INGEST_TASK)  # type: ignore[untyped-decorator]
def ingest_recording(
    path: str, map_name: str | None = None, name: str | None = None, options: Mapping[str, Any] | None = None
) -> list[dict[str, Any]]:
    """Ingest the whole recording at `path`, which the worker must see under that path, in this one task.

    `options`: ``keyframes`` and ``stride`` (int), ``camera`` (text as for ``--camera``). Returns what was stored of
    each recording. Raises `SemdbError`, which Celery logs; the task sent again goes on where this one stopped.
    """
    from semdb.errors import UsageError
    from semdb.ingest import IngestOptions, ingest_recordings

    given = dict(options or {})
    unknown = sorted(set(given) - {"keyframes", "stride", "camera"})
    if unknown:
        raise UsageError(f"{INGEST_TASK} has no option {unknown[0]!r}: keyframes, stride, camera")
    summaries = ingest_recordings([path], Settings(), IngestOptions(map_name=map_name, name=name, **given))
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
