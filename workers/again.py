"""Messages that are not done go back to the broker: some for later, others for another worker; none for ever.

Celery takes a message whose task raised for done. So every error of a task comes here. How long is waited is said in
one place, `semdb.database.retry`. How often workers failed at a message, it says itself, in a header.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any, NoReturn

from celery.exceptions import Ignore, Reject, SoftTimeLimitExceeded

from semdb.database import retry
from semdb.database.items import LEASE_S, MOST_ATTEMPTS
from semdb.errors import DatabaseError, ModelError, SemdbError, UnstorableError
from semdb.events import event
from semdb.ingestion.queue import ChunkOutcome

from . import BrokerError, metrics, send_items, stopping

LOOK_S = 0.1  # between looks whether a worker that pauses is to stop
MOST_FAILURES = 10  # of workers at one message, whose recording it is that they fail at
MOST_LOSSES = MOST_ATTEMPTS + 2  # of workers that were killed over one message: its keyframes are counted, too
MOST_TRIES = 300  # of a message in all: about a day
FAILURES, LOSSES = "semdb_failures", "semdb_losses"  # headers
# A wrong file of a network, account or schema, a full disk: what another worker need not have.
OF_THE_WORKER = (ModelError, DatabaseError, OSError, MemoryError, ImportError)
MAY_HEAL = (*retry.MAY_HEAL, SoftTimeLimitExceeded, BrokerError)
GiveUp = Callable[[str], None]
_faults: list[str] = []  # of this process, since it has last done a message


class LostWorkerError(SemdbError):
    """A worker did not come back."""


def nothing(_why: str) -> None:
    """Nothing is kept of a message that is given up."""


def not_done(task: Any, error: Exception, give_up: GiveUp, **fields: Any) -> NoReturn:
    """What becomes of the message of `task`, at which it failed.

    What may heal is tried again later. For a fault of this worker the message goes to another at once. Anything else
    is of the recording: others try, later each time, and when `MOST_FAILURES` have failed `give_up` is told why.
    """
    if isinstance(error, MAY_HEAL):
        _later(task, error, **fields)
    if isinstance(error, OF_THE_WORKER) and not isinstance(error, UnstorableError):
        _by_another(task, error, **fields)
    _by_others(task, error, give_up, **fields)


def refuse(task_name: str, error: SemdbError) -> NoReturn:
    """Ends a message that no worker could ever do."""
    metrics.fault("refused")
    event("given_up", level=logging.ERROR, task=task_name, error=str(error))
    raise Ignore from error


def count_losses(task: Any, give_up: GiveUp, **fields: Any) -> None:
    """Counts how often a worker was lost over the message of `task`: killed, or gone without a word.

    The broker says that much of a message, and no more. So one that came back is sent anew, with a count, before
    anything of it is touched. Raises what `task` is to raise then; when that was `MOST_LOSSES` times, it is given up.
    """
    if not (task.request.delivery_info or {}).get("redelivered"):
        return
    losses = _header(task, LOSSES) + 1
    if losses >= MOST_LOSSES:
        _give_up(task, LostWorkerError(f"workers were lost {losses} times over this message"), give_up, **fields)
    raise _sent_again(task, LostWorkerError("a worker was lost"), 0.0, losses=losses)


def _later(task: Any, error: Exception, **fields: Any) -> NoReturn:
    if task.request.retries >= MOST_TRIES:  # its keyframes are in the plan: a sweep sends them
        _give_up(task, error, nothing, **fields)
    delay = retry.task_delay_s(max(0, task.request.retries - _header(task, LOSSES) - _header(task, FAILURES)))
    metrics.retried("task")
    event("retry", **fields, seconds=round(delay, 1), error=str(error))
    raise _sent_again(task, error, delay) from error


def _by_another(task: Any, error: Exception, **fields: Any) -> NoReturn:
    """Lets this process pause, longer each time until it has done a message.

    It may have other models, an old password, or a full disk, and others not: so it must not take what they can do. It
    tries again after its pause, for nobody tells it that it was mended.
    """
    if task.request.retries >= MOST_TRIES:
        _give_up(task, error, nothing, **fields)
    pause = retry.task_delay_s(len(_faults))
    _faults.append(type(error).__name__)
    metrics.fault(_faults[-1])
    _note("refused", error, **fields, seconds=round(pause, 1))
    answer = _sent_again(task, error, 0.0)
    _pause(pause)
    raise answer from error


def _by_others(task: Any, error: Exception, give_up: GiveUp, **fields: Any) -> NoReturn:
    failures = _header(task, FAILURES) + 1
    if failures >= MOST_FAILURES or task.request.retries >= MOST_TRIES:
        _give_up(task, error, give_up, **fields)
    delay = retry.task_delay_s(failures - 1)
    metrics.fault(type(error).__name__)
    _note("refused", error, **fields, seconds=round(delay, 1))
    raise _sent_again(task, error, delay, failures=failures) from error


def _give_up(task: Any, error: Exception, give_up: GiveUp, **fields: Any) -> NoReturn:
    metrics.fault(type(error).__name__)
    try:
        give_up(_text(error))
    except SemdbError as unnoted:  # the database is away: the keyframes stay in the plan
        fields["unnoted"] = str(unnoted)
    _note("given_up", error, **fields, task=task.name)
    raise Ignore from error


def at_once(task: Any, error: Exception, **fields: Any) -> NoReturn:
    """Sends the message of `task` again, as this worker is to stop."""
    event("stopped", **fields)
    raise _sent_again(task, error, 0.0) from error


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


def _sent_again(
    task: Any, error: Exception, delay_s: float, *, failures: int | None = None, losses: int | None = None
) -> Exception:
    """What `task` is to raise after its message was sent again; where the broker takes none, the old one comes back."""
    headers = {
        FAILURES: _header(task, FAILURES) if failures is None else failures,
        LOSSES: _header(task, LOSSES) if losses is None else losses,
    }
    answer: Exception
    try:
        answer = task.retry(exc=error, countdown=delay_s, throw=False, headers=headers)
    except Reject as refused:
        answer = Reject(refused.reason, requeue=True)
    return answer


def _header(task: Any, name: str) -> int:
    value = task.request.get(name, 0)
    return value if isinstance(value, int) and value > 0 else 0


def _text(error: Exception) -> str:
    return str(error) if isinstance(error, SemdbError) else f"{type(error).__name__}: {error}"


def _note(name: str, error: Exception, **fields: Any) -> None:
    """Logs it; of an error that no code here knows with its traceback."""
    unknown = None if isinstance(error, SemdbError) else error
    event(name, level=logging.ERROR, exc_info=unknown, **fields, error=f"{type(error).__name__}: {error}")


def _pause(seconds: float) -> None:
    """Until the time is over, the worker is to stop, or the time limit of the task comes: its message is sent."""
    end = time.monotonic() + seconds
    try:
        while time.monotonic() < end and not stopping.is_set():
            time.sleep(LOOK_S)
    except SoftTimeLimitExceeded:
        return
