"""What takes messages from the broker: one that is no task's is refused with one line, whatever it is.

Celery's own consumer writes tracebacks, and ends the worker over some of them; the broker then gives the message to the
next one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

from celery.worker.consumer import Consumer

from . import LONGEST, again, say_refused

FOLLOWERS = ("callbacks", "errbacks", "chain")
_TEXTS = ("task", "id", "lang", "eta", "expires", "root_id", "parent_id", "group", "origin", "argsrepr", "kwargsrepr")
_HEADERS: dict[str, tuple[type, ...]] = {**dict.fromkeys(_TEXTS, (str,)), "redelivered": (bool,)}
_COUNTS = ("retries", again.FAILURES, again.LOSSES)


def _tidy(headers: Any) -> None:
    """Leaves in `headers` what is needed, in the form that Celery gives it: the rest may stop it half-way.

    Limits of time are those of the task; a sender has no say in them. Raises ValueError without the names.
    """
    if not isinstance(headers, dict):
        raise ValueError("it is no message of Celery")
    if not all(isinstance(headers.get(name, ""), str) for name in ("task", "id")):
        raise ValueError("task and id are texts")
    kept = {name: headers[name] for name, kinds in _HEADERS.items() if isinstance(headers.get(name), kinds)}
    for name in _COUNTS:
        value = headers.get(name)
        kept[name] = value if type(value) is int and 0 <= value < 2**31 else 0
    headers.clear()
    headers.update(kept, timelimit=[None, None])


def _check(body: Any) -> None:
    """Raises ValueError for a body that is no arguments: a list of them, names with values, and what follows."""
    fits = isinstance(body, list | tuple) and len(body) == 3
    fits = fits and isinstance(body[0], list) and isinstance(body[1], dict) and isinstance(body[2], dict | None)
    if fits and body[2]:
        fits = all(value is None or isinstance(value, list) for value in map(body[2].get, FOLLOWERS))
    if not fits:
        raise ValueError("its body is not arguments, names with values, and what follows")


class CarefulConsumer(Consumer):  # type: ignore[misc]
    """Celery's consumer of messages, named in the setting ``worker_consumer``."""

    def create_task_handler(self, *given: Any, **named: Any) -> Callable[[Any], Any]:
        """As Celery's, for any message."""
        handle = super().create_task_handler(*given, **named)

        def careful(message: Any) -> Any:
            try:
                _tidy(message.headers)
                _check(message.payload)
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
        say_refused(error)
        if not message.acknowledged:
            message.reject_log_error(logging.getLogger("celery"), self.connection_errors)
