"""What `semdb.connect` gives: the interface of `semdb.open`, answered by a service over HTTP."""

from semdb.client.aio import AsyncDatabase
from semdb.client.database import RemoteDatabase, connect, connect_async

__all__ = ["AsyncDatabase", "RemoteDatabase", "connect", "connect_async"]
