"""What workers do. Task names are part of the interface: senders know them, not this module."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from celery.exceptions import Reject, SoftTimeLimitExceeded

from semdb.database import retry
from semdb.errors import RecordingError, RecordingUnavailableError, UsageError
from semdb.events import event
from semdb.ingestion.queue import Workplace, queue_recordings
from semdb.ingestion.run import IngestOptions
from semdb.ingestion.work import log_item
from semdb.recordings.options import read_options
from semdb.recordings.source import is_address
from semdb.settings import Settings

from . import (
    HARD_LIMIT_S,
    INGEST_TASK,
    ITEMS_TASK,
    SOFT_LIMIT_S,
    BrokerError,
    again,
    app,
    metrics,
    send_items,
    stopping,
)

OPTIONS: dict[str, type] = {"keyframes": int, "stride": int, "camera": str, "reading": str}  # of a whole recording
PLAN_TRIES = 10  # of a recording that a worker refuses to plan: the next one may have the detector for it
LIMITS = {"bind": True, "soft_time_limit": SOFT_LIMIT_S, "time_limit": HARD_LIMIT_S, "max_retries": None}
_workplaces: list[Workplace] = []  # of this process, made by its first task


@app.task(name=ITEMS_TASK, **LIMITS)  # type: ignore[untyped-decorator]
def ingest_items(self: Any, recording_id: int, source: str, frames: Sequence[int]) -> dict[str, int]:
    """Describe and store keyframes `frames` of a planned recording, those that nobody else has.

    What may heal (database gone, mount lost) is tried again with back-off; any other error is a fault of this worker:
    the message goes to another. A frame that cannot be read is `failed` in the database and no error here. What
    somebody else is at is sent again, until it is done. Returns counts.
    """

    def note(item: Any) -> None:
        metrics.count(item)
        log_item(recording_id, item)

    what: dict[str, Any] = {"recording": recording_id, "frames": len(frames)}
    try:
        if not _workplaces:
            _workplaces.append(Workplace(Settings()))
        outcome = _workplaces[0].do(recording_id, source, frames, stop=stopping.is_set, note=note)
        again.done(recording_id, source, outcome)
    except Reject:
        raise
    except (*retry.MAY_HEAL, SoftTimeLimitExceeded) as error:
        again.later(self, error, **what)
    except Exception as error:
        again.by_another(self, error, **what)
    if outcome.gone:
        event("dropped", **what)
    if outcome.complete:
        event("complete", recording=recording_id)
    return {"stored": outcome.stored, "failed": len(outcome.failed), "lost": outcome.lost, "left": len(outcome.left)}


@app.task(name=INGEST_TASK, **LIMITS)  # type: ignore[untyped-decorator]
def ingest_recording(
    self: Any,
    path: str,
    map_name: str | None = None,
    name: str | None = None,
    options: Mapping[str, Any] | None = None,
) -> list[dict[str, Any]]:
    """Plan the recordings at `path`, which workers must see under that path, and send their keyframes to the workers.

    `options`: ``keyframes`` and ``stride`` (int), ``camera`` (text as for ``--camera``), ``reading`` (text such as
    ``depth_scale=1000&axes=ros``, see `semdb.recordings.options.ReadOptions`). Returns what was planned of
    each recording. What may heal, a path that is not there among it, is tried again with back-off. What this worker
    refuses is tried `PLAN_TRIES` times, then UsageError or RecordingError is raised, which Celery logs.
    """
    given = _checked(options or {})
    try:
        reading = read_options(given.pop("reading", ""))
        planned = _plan(path, IngestOptions(map_name=map_name, name=name, reading=reading, **given))
    except _StopsError as error:
        again.at_once(self, error, path=path)
    except (*retry.MAY_HEAL, SoftTimeLimitExceeded, BrokerError) as error:
        again.later(self, error, path=path)
    except (UsageError, RecordingError) as error:
        if self.request.retries >= PLAN_TRIES:
            raise
        again.later(self, error, path=path)
    except Exception as error:
        again.by_another(self, error, path=path)
    return planned


def _checked(options: Mapping[str, Any]) -> dict[str, Any]:
    """`options` without those that are not set. Raises UsageError: no worker could ever do such a message."""
    for option, value in options.items():
        if option not in OPTIONS:
            raise UsageError(f"{INGEST_TASK} has no option {option!r}: {', '.join(OPTIONS)}")
        if value is not None and not isinstance(value, OPTIONS[option]):
            raise UsageError(
                f"{INGEST_TASK}: the option {option!r} is {value!r}, not of type {OPTIONS[option].__name__}"
            )
    return {option: value for option, value in options.items() if value is not None}


class _StopsError(Exception):
    """The worker is to stop before the plan is made."""


def _plan(path: str, options: IngestOptions) -> list[dict[str, Any]]:
    def look(_what: str, _done: int, _total: int) -> None:
        if stopping.is_set():
            raise _StopsError

    look("", 0, 0)
    if not is_address(path) and not Path(path).exists():
        raise RecordingUnavailableError(f"{path}: there is no such folder or file on this machine")
    summaries = queue_recordings([path], Settings(), options, send_items, progress=look)
    return [
        {
            "map": summary.map_name,
            "recording": summary.recording,
            "planned": summary.planned,
            "already_stored": summary.already_stored,
        }
        for summary in summaries
    ]
