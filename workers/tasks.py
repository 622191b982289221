"""What workers do. Task names are part of the interface: senders know them, not this module."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from celery.exceptions import Reject

from semdb.errors import RecordingError, RecordingUnavailableError, UsageError
from semdb.events import event
from semdb.ingestion.queue import Workplace, queue_recordings
from semdb.ingestion.work import log_item
from semdb.recordings.source import is_address
from semdb.settings import Settings

from . import HARD_LIMIT_S, INGEST_TASK, ITEMS_TASK, SOFT_LIMIT_S, again, app, metrics, send_items, stopping
from .messages import ItemsMessage, PlanMessage, items_message, plan_message

LIMITS = {"bind": True, "soft_time_limit": SOFT_LIMIT_S, "time_limit": HARD_LIMIT_S, "max_retries": None}
_workplaces: list[Workplace] = []  # of this process, made by its first task


def _workplace() -> Workplace:
    if not _workplaces:
        _workplaces.append(Workplace(Settings()))
    return _workplaces[0]


@app.task(name=ITEMS_TASK, **LIMITS)  # type: ignore[untyped-decorator]
def ingest_items(self: Any, *given: Any, **named: Any) -> dict[str, int]:
    """Describe and store keyframes of a planned recording, those that nobody else has.

    Arguments: recording_id, source, frames; anything else is refused once. A frame that cannot be read or stored is
    `failed` in the database and no error here. What comes of errors says `again.not_done`. What somebody else is at is
    sent again, until it is done. Returns counts.
    """
    try:
        message = items_message(given, named)
    except UsageError as error:
        again.refuse(ITEMS_TASK, error)
    what: dict[str, Any] = {"recording": message.recording_id, "frames": len(message.frames)}

    def give_up(why: str) -> None:
        _workplace().give_up(message.recording_id, message.frames, why)

    again.count_losses(self, give_up, **what)
    try:
        return _ingest(message, what)
    except Reject:
        raise
    except Exception as error:
        again.not_done(self, error, give_up, **what)


def _ingest(message: ItemsMessage, what: dict[str, Any]) -> dict[str, int]:
    def note(item: Any) -> None:
        metrics.count(item)
        log_item(message.recording_id, item)

    outcome = _workplace().do(message.recording_id, message.source, message.frames, stop=stopping.is_set, note=note)
    again.done(message.recording_id, message.source, outcome)
    if outcome.gone:
        event("dropped", **what)
    if outcome.complete:
        event("complete", recording=message.recording_id)
    return {"stored": outcome.stored, "failed": len(outcome.failed), "lost": outcome.lost, "left": len(outcome.left)}


@app.task(name=INGEST_TASK, **LIMITS)  # type: ignore[untyped-decorator]
def ingest_recording(self: Any, *given: Any, **named: Any) -> list[dict[str, Any]]:
    """Plan the recordings at a path, which workers must see under that path, and send their keyframes to the workers.

    Arguments: path, map_name, name, options; all but the first may be left out, and anything else is refused once.
    `options`: ``keyframes`` and ``stride`` (int), ``camera`` (text as for ``--camera``), ``reading`` (text such as
    ``depth_scale=1000&axes=ros``, see `semdb.recordings.options.ReadOptions`). Returns what was planned of each
    recording. What comes of errors says `again.not_done`; a path that is not there may come back.
    """
    settings = Settings()
    try:
        message = plan_message(given, named, settings.roots)
    except UsageError as error:
        again.refuse(INGEST_TASK, error)
    again.count_losses(self, again.nothing, path=message.path)
    try:
        return _plan(message, settings)
    except _StopsError as error:
        again.at_once(self, error, path=message.path)
    except RecordingUnavailableError as error:
        again.not_done(self, error, again.nothing, path=message.path)
    except RecordingError as error:  # no worker could read it
        again.refuse(INGEST_TASK, error)
    except Exception as error:
        again.not_done(self, error, again.nothing, path=message.path)


class _StopsError(Exception):
    """The worker is to stop before the plan is made."""


def _plan(message: PlanMessage, settings: Settings) -> list[dict[str, Any]]:
    def look(_what: str, _done: int, _total: int) -> None:
        if stopping.is_set():
            raise _StopsError

    look("", 0, 0)
    if not is_address(message.path) and not Path(message.path).exists():
        raise RecordingUnavailableError(f"{message.path}: there is no such folder or file on this machine")
    summaries = queue_recordings([message.path], settings, message.options, send_items, progress=look)
    return [
        {
            "map": summary.map_name,
            "recording": summary.recording,
            "planned": summary.planned,
            "already_stored": summary.already_stored,
        }
        for summary in summaries
    ]
