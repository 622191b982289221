"""Messages that are not done go back to the broker: some for later, others for another worker, at once.

Celery takes a message whose task raised for done. So every error of a task comes here but those of messages that can
never be done. How long is waited is said in one place, `semdb.database.retry`.
"""

from __future__ import annotations

import logging
import time
import traceback
from typing import Any, NoReturn

from celery.exceptions import Reject, SoftTimeLimitExceeded

from semdb.database import retry
from semdb.database.items import LEASE_S
from semdb.errors import SemdbError
from semdb.events import event
from semdb.ingestion.queue import ChunkOutcome

from . import BrokerError, metrics, send_items, stopping

LOOK_S = 0.1  # between looks whether a worker that pauses is to stop
_faults: list[str] = []  # of this process, since it has last done a message


def later(task: Any, error: Exception, **fields: Any) -> NoReturn:
    """Sends the message of `task` again, to be done after a pause: for an `error` that may heal."""
    delay = retry.task_delay_s(task.request.retries)
    metrics.retried("task")
    event("retry", **fields, seconds=round(delay, 1), error=str(error))
    raise sent_again(task, error, delay) from error


def by_another(task: Any, error: Exception, **fields: Any) -> NoReturn:
    """Sends the message of `task` again, at once, and lets this process pause: for a fault of this worker.

    It may have other models, an old password, or a full disk, and others not: so it must not take what they can do. It
    tries again after its pause, for nobody tells it that it was mended.
    """
    pause = retry.task_delay_s(len(_faults))
    _faults.append(type(error).__name__)
    metrics.fault(_faults[-1])
    if not isinstance(error, SemdbError):
        fields["traceback"] = "".join(traceback.format_exception(error))
    event("refused", level=logging.ERROR, **fields, seconds=round(pause, 1), error=f"{_faults[-1]}: {error}")
    answer = sent_again(task, error, 0.0)
    _pause(pause)
    raise answer from error


def at_once(task: Any, error: Exception, **fields: Any) -> NoReturn:
    """Sends the message of `task` again, as this worker is to stop."""
    event("stopped", **fields)
    raise sent_again(task, error, 0.0) from error


def done(recording_id: int, source: str, outcome: ChunkOutcome) -> None:
    """Takes note of a message that this worker could do, and sends on what is open of it.

    Raises Reject where the broker takes no message: then the old one comes back.
    """
    _faults.clear()
    try:
        if outcome.left:
            send_items(recording_id, source, outcome.left)
        if outcome.held:  # when its lease has run out another worker may have it
            send_items(recording_id, source, outcome.held, delay_s=LEASE_S)
    except BrokerError as error:
        event("retry", recording=recording_id, error=str(error))
        raise Reject(error, requeue=True) from error


def sent_again(task: Any, error: Exception, delay_s: float) -> Exception:
    """What `task` is to raise after its message was sent again; where the broker takes none, the old one comes back."""
    answer: Exception
    try:
        answer = task.retry(exc=error, countdown=delay_s, throw=False)
    except Reject as refused:
        answer = Reject(refused.reason, requeue=True)
    return answer


def _pause(seconds: float) -> None:
    """Until the time is over, the worker is to stop, or the time limit of the task comes: its message is sent."""
    end = time.monotonic() + seconds
    try:
        while time.monotonic() < end and not stopping.is_set():
            time.sleep(LOOK_S)
    except SoftTimeLimitExceeded:
        return
