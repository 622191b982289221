"""The Celery application ``semdb.workers``: ``celery --app semdb.workers worker``. Thin over `semdb.ingestion.queue`.

The broker is the setting SEMDB_BROKER_URL. Messages say what to do, the database says what is done: a message may
be lost or arrive twice, and running a task again adds nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

try:
    from celery import Celery
    from kombu.transport import TRANSPORT_ALIASES
except ImportError as error:
    raise ImportError("semdb.workers needs the worker extra: pip install 'semdb[worker]'") from error

from semdb.errors import SemdbError
from semdb.events import event
from semdb.settings import Settings

# Kombu's own end a worker over an item that is no message.
ALIASES = {
    "redis": "semdb.workers.broker:CarefulTransport",
    "rediss": "semdb.workers.broker:CarefulTransport",
    "sentinel": "semdb.workers.broker:CarefulSentinelTransport",
}
INGEST_TASK = "semdb.ingest_recording"
ITEMS_TASK = "semdb.ingest_items"
LONGEST = 200  # characters of a line about what anybody may have sent
SOFT_LIMIT_S = 600  # for the keyframes of one message
HARD_LIMIT_S = SOFT_LIMIT_S + 60
SOCKET_LIMITS = {"socket_timeout": 10, "socket_connect_timeout": 5}
VISIBILITY_S = HARD_LIMIT_S + 240  # a message that nobody acknowledged for so long is given to another worker


class BrokerError(SemdbError):
    """The broker does not answer."""


@dataclass(frozen=True, slots=True)
class Node:
    """A worker that answers: its name, ``celery@MACHINE``, and the numbers of the processes that do its work."""

    name: str
    processes: tuple[int, ...]


def make_app(settings: Settings) -> Any:
    """The Celery application for `settings`; its tasks are found by name when a worker starts."""
    TRANSPORT_ALIASES.update(ALIASES)  # by name: the client of Redis is only needed for Redis
    application = Celery("semdb", broker=settings.broker_url, include=["semdb.workers.tasks", "semdb.workers.process"])
    application.conf.update(
        task_ignore_result=True,  # the database holds the outcome
        task_acks_late=True,  # a worker that dies gives its message back
        task_reject_on_worker_lost=True,
        task_acks_on_failure_or_timeout=False,  # nor takes one with it whose process was killed at the hard limit
        worker_prefetch_multiplier=1,
        task_serializer="json",
        accept_content=["json"],
        broker_connection_retry_on_startup=True,
        broker_connection_max_retries=None,  # a broker that is gone may come back
        worker_cancel_long_running_tasks_on_connection_loss=False,  # they go on: only their message is lost
        broker_transport_options={
            "visibility_timeout": VISIBILITY_S,
            "socket_timeout": 10,
            "socket_connect_timeout": 5,
        },
        task_default_queue="semdb",
        worker_hijack_root_logger=False,
        worker_consumer="semdb.workers.consumer:CarefulConsumer",
    )
    return application


app = make_app(Settings())


def send_items(recording_id: int, source: str, frames: Sequence[int], *, delay_s: float | None = None) -> None:
    """Sends one message that names keyframes, to be done after `delay_s` where given.

    Raises BrokerError: they stay planned, and a sweep sends them.
    """
    from kombu.exceptions import OperationalError

    try:
        app.send_task(
            ITEMS_TASK,
            args=[recording_id, source, list(frames)],
            countdown=delay_s,
            retry=True,
            retry_policy={"max_retries": 3},
        )
    except (OperationalError, OSError) as error:
        where = app.connection_for_write().as_uri()  # without the password
        raise BrokerError(
            f"the broker {where} does not answer ({error}); the plan is in the database: when the broker is back, run "
            "`semdb ingest --resume`"
        ) from error


def say_refused(error: Exception) -> None:
    """Says that what somebody put into the broker is no message: once, for it is gone from there."""
    from . import metrics

    metrics.fault("refused")
    first = str(error).partition("\n")[0][:LONGEST]
    event("given_up", level=logging.ERROR, error=f"a message that is none: {type(error).__name__}: {first}")


def nodes(settings: Settings, seconds: float = 1.0) -> list[Node]:
    """The workers at the broker of `settings` that answer within `seconds`, by name. Raises BrokerError."""
    from kombu.exceptions import OperationalError

    application = make_app(settings)
    with application.connection_for_write() as connection:
        try:
            connection.ensure_connection(max_retries=1, timeout=5)
            answers = application.control.inspect(timeout=seconds, connection=connection).stats() or {}
        except (OperationalError, OSError) as error:
            where = connection.as_uri()  # without the password
            raise BrokerError(
                f"the broker {where} does not answer ({error}): start it, or check SEMDB_BROKER_URL"
            ) from error
    found = {name: answer.get("pool", {}).get("processes", ()) for name, answer in answers.items()}
    return [Node(name, tuple(int(pid) for pid in found[name])) for name in sorted(found)]
