"""What `semdb.connect` gives: the interface of `semdb.open`, answered by a service over HTTP."""

from semdb.client.aio import AsyncDatabase, connect_async
from semdb.client.database import RemoteDatabase, connect

__all__ = ["AsyncDatabase", "RemoteDatabase", "connect", "connect_async"]
