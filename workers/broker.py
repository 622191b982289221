"""Redis as a broker into which anybody may have written: what is no message of Celery is refused once, with one line.

Kombu reads each item of the list, and of what workers have in hand, as JSON of its own kind. One that is not ends the
worker with a traceback, or, among what is in hand, every worker again and again.
"""

from __future__ import annotations

import base64
from queue import Empty
from typing import Any

from kombu.transport import redis

from . import say_refused


def check_envelope(message: Any) -> None:
    """Raises ValueError for what is no message as kombu writes it, before anything of it is kept."""
    if not isinstance(message, dict) or not isinstance(message.get("properties"), dict):
        raise ValueError("it is no message of Celery")
    properties = message["properties"]
    kinds = (
        (message.get("headers"), dict | None),
        (message.get("body"), str | None),
        (message.get("content-type"), str | None),
        (message.get("content-encoding"), str | None),
        (properties.get("delivery_tag"), str),
        (properties.get("delivery_info"), dict),
        (properties.get("body_encoding"), str | None),
    )
    if not all(isinstance(value, kind) for value, kind in kinds):
        raise ValueError("its parts are not those of a message of Celery")
    if not all(isinstance(properties["delivery_info"].get(name), str) for name in ("exchange", "routing_key")):
        raise ValueError("it does not say where it was sent")
    properties["delivery_tag"].encode()  # an UnicodeEncodeError, which is a ValueError
    if properties.get("body_encoding") == "base64":
        base64.b64decode((message.get("body") or "").encode())  # a ValueError
    elif properties.get("body_encoding") is not None:
        raise ValueError("its body is not in base64")
    if (message.get("headers") or {}).get("compression") is not None:
        raise ValueError("its body is compressed, which semdb's messages are not")


class CarefulQoS(redis.QoS):  # type: ignore[misc]
    """What workers have in hand, in a hash of its own."""

    def restore_by_tag(self, tag: Any, client: Any = None, leftmost: bool = False) -> None:
        """As kombu's; what cannot be given back is taken out of the hash and of its index."""
        try:
            super().restore_by_tag(tag, client, leftmost)
        except (*self.channel.connection_errors, MemoryError):
            raise
        except Exception as error:
            with self.channel.conn_or_acquire(client) as connection, connection.pipeline() as pipe:
                self._remove_from_indices(tag, pipe).execute()
            say_refused(error)


class _Careful:
    """A channel that takes anything off the lists."""

    QoS = CarefulQoS

    def _brpop_read(self, **options: Any) -> Any:
        try:
            return super()._brpop_read(**options)  # type: ignore[misc]
        except (Empty, *self.connection_errors, *self.connection.channel_errors, MemoryError):  # type: ignore[attr-defined]
            raise
        except Exception as error:  # it is off the list already
            say_refused(error)
        return True

    def _do_restore_message(self, payload: Any, *given: Any, **named: Any) -> None:
        try:
            check_envelope(payload)
        except ValueError as error:  # whoever asks takes it out of the hash
            say_refused(error)
        else:
            super()._do_restore_message(payload, *given, **named)  # type: ignore[misc]


class CarefulChannel(_Careful, redis.Channel):  # type: ignore[misc]
    """Of one Redis."""


class CarefulSentinelChannel(_Careful, redis.SentinelChannel):  # type: ignore[misc]
    """Of a Redis that sentinels name."""


class _Checking:
    """A transport that looks at each message before a consumer gets it."""

    def _deliver(self, message: Any, queue: Any) -> None:
        try:
            check_envelope(message)
        except ValueError as error:
            say_refused(error)
        else:
            super()._deliver(message, queue)  # type: ignore[misc]


class CarefulTransport(_Checking, redis.Transport):  # type: ignore[misc]
    """For ``redis://`` and ``rediss://``."""

    Channel = CarefulChannel


class CarefulSentinelTransport(_Checking, redis.SentinelTransport):  # type: ignore[misc]
    """For ``sentinel://``."""

    Channel = CarefulSentinelChannel
