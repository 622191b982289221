"""What takes messages from the broker: one that is no task's is refused with one line, whatever it is.

Celery's own consumer writes tracebacks, and ends the worker over some of them; the broker then gives the message to the
next one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from celery.worker.consumer import Consumer

from semdb.events import event

from . import metrics

LONGEST = 200  # characters of a line about what anybody may have sent


def _tidy(headers: Any) -> None:
    """Takes out of `headers` what a sender has no say in, and what would stop Celery half-way. Raises ValueError."""
    if not isinstance(headers, dict):
        raise ValueError("it is no message of Celery")
    if not isinstance(headers.get("id", ""), str) or not isinstance(headers.get("task", ""), str):
        raise ValueError("task and id are texts")
    headers["timelimit"] = [None, None]  # those of the task
    retries = headers.get("retries")
    if not isinstance(retries, int) or not 0 <= retries < 2**31:
        headers["retries"] = 0


class CarefulConsumer(Consumer):  # type: ignore[misc]
    """Celery's consumer of messages, named in the setting ``worker_consumer``."""

    def create_task_handler(self, *given: Any, **named: Any) -> Callable[[Any], Any]:
        """As Celery's, for any message."""
        handle = super().create_task_handler(*given, **named)

        def careful(message: Any) -> Any:
            try:
                _tidy(message.headers)
                return handle(message)
            except (*self.connection_errors, MemoryError):
                raise
            except Exception as error:
                self._refuse(message, error)
            return None

        return careful

    def on_decode_error(self, message: Any, exc: Exception) -> None:
        """For a body that is no JSON, or too deep."""
        self._refuse(message, exc)

    def on_unknown_message(self, body: Any, message: Any) -> None:
        """For what has not the form of a message of Celery."""
        self._refuse(message, ValueError("it is no message of Celery"))

    def on_unknown_task(self, body: Any, message: Any, exc: Exception) -> None:
        """For a task that is not semdb's."""
        self._refuse(message, ValueError(f"there is no task {str(exc)[:LONGEST]}"))

    def on_invalid_task(self, body: Any, message: Any, exc: Exception) -> None:
        """For arguments or headers that make no sense, or a body in another format than JSON."""
        self._refuse(message, exc)

    def _refuse(self, message: Any, error: Exception) -> None:
        metrics.fault("refused")
        first = str(error).partition("\n")[0][:LONGEST]
        event("given_up", level=logging.ERROR, error=f"a message that is none: {type(error).__name__}: {first}")
        if not message.acknowledged:
            message.reject_log_error(logging.getLogger("celery"), self.connection_errors)
