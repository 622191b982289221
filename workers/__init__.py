"""The Celery application ``semdb.workers``: ``celery --app semdb.workers worker``. Thin over `semdb.ingest`.

The broker is the setting SEMDB_BROKER_URL. Messages say what to do, the database says what is done: a message may
be lost or arrive twice, and running a task again adds nothing.
"""

from __future__ import annotations

from typing import Any

try:
    from celery import Celery
except ImportError as error:
    raise ImportError("semdb.workers needs the worker extra: pip install 'semdb[worker]'") from error

from semdb.settings import Settings

INGEST_TASK = "semdb.ingest_recording"


def make_app(settings: Settings) -> Any:
    """The Celery application for `settings`; its tasks are found by name when a worker starts."""
    application = Celery("semdb", broker=settings.broker_url, include=["semdb.workers.tasks"])
    application.conf.update(
        task_ignore_result=True,  # the database holds the outcome
        task_acks_late=True,  # a worker that dies gives its message back
        task_reject_on_worker_lost=True,
        worker_prefetch_multiplier=1,
        task_serializer="json",
        accept_content=["json"],
        broker_connection_retry_on_startup=True,
        broker_transport_options={"visibility_timeout": 6 * 3600},  # longer than a recording takes
        task_default_queue="semdb",
    )
    return application


app = make_app(Settings())
