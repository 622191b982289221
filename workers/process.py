"""The life of a worker: logs and metrics when it starts, a sweep when it is ready, a word to its tasks when it ends."""

from __future__ import annotations

import logging
from typing import Any

from celery import signals

from semdb.database import retry
from semdb.database.store import open_store
from semdb.errors import SemdbError
from semdb.events import LOGGER, JsonFormatter, PlainFormatter, event
from semdb.ingestion.queue import sweep
from semdb.settings import Settings

from . import metrics, send_items, stopping


@signals.worker_init.connect  # type: ignore[untyped-decorator]
def _prepare(**_: Any) -> None:
    stopping.clear()
    if Settings().metrics_port is not None:
        metrics.prepare()
    retry.listeners.append(lambda: metrics.retried("transaction"))
    _load()


def _load() -> None:
    """Imports what tasks need before the worker forks: a process that replaces a killed one is ready at once."""
    import semdb.perception.encoders
    import semdb.perception.features.surf  # noqa: F401


@signals.after_setup_logger.connect  # type: ignore[untyped-decorator]
def _logs(logger: logging.Logger, **_: Any) -> None:
    LOGGER.setLevel(logging.INFO)
    in_json = Settings().log_format == "json"
    for handler in (*logger.handlers, *LOGGER.handlers):
        handler.setFormatter(JsonFormatter() if in_json else _plain(handler.formatter))


def _plain(formatter: logging.Formatter | None) -> logging.Formatter:
    """Celery's own lines, in which names are no code either."""
    return formatter if isinstance(formatter, PlainFormatter) else PlainFormatter(formatter)


@signals.after_setup_task_logger.connect  # type: ignore[untyped-decorator]
def _task_logs(logger: logging.Logger, **_: Any) -> None:
    _logs(logger)


@signals.worker_ready.connect  # type: ignore[untyped-decorator]
def _ready(**_: Any) -> None:
    settings = Settings()
    _sweep(settings)
    if settings.metrics_port is None:
        return
    try:
        metrics.serve(settings.metrics_port)
    except OSError as error:  # another worker has the port: keyframes are worth more than numbers about them
        event("metrics", level=logging.ERROR, port=settings.metrics_port, error=f"not served: {error}")


def _sweep(settings: Settings) -> None:
    try:
        with open_store(settings.database_url) as store:
            sent = sweep(store, send_items)
    except SemdbError as error:  # the worker still does what it is sent
        event("sweep", level=logging.ERROR, error=str(error))
    else:
        event("sweep", sent=sent)


@signals.worker_shutting_down.connect  # type: ignore[untyped-decorator]
def _stop(**_: Any) -> None:
    stopping.request()


@signals.worker_shutdown.connect  # type: ignore[untyped-decorator]
def _ended(**_: Any) -> None:
    metrics.remove()
