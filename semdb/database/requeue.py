"""Putting keyframes that failed back into the plan of their recording."""

from __future__ import annotations

from sqlalchemy import Connection, Engine, update

from semdb.database import retry
from semdb.database.records import ItemState, RecordingState
from semdb.database.tables import ingest_items, recordings


def requeue_failed(engine: Engine, recording_id: int) -> int:
    """Make the failed keyframes of a recording pending again, and the recording unfinished. Returns how many.

    Attempts and the last error stay, so that the status tells the history. Raises `DatabaseError`.
    """
    item = ingest_items.c

    def work(connection: Connection) -> int:
        failed = (item.recording_id == recording_id, item.state == ItemState.FAILED.value)
        number = connection.execute(update(ingest_items).where(*failed).values(state=ItemState.PENDING.value)).rowcount
        if number:
            complete = (recordings.c.id == recording_id, recordings.c.state == RecordingState.COMPLETE.value)
            values = {"state": RecordingState.INGESTING.value, "finished_at": None}
            connection.execute(update(recordings).where(*complete).values(values))
        return number

    return retry.write(engine, work)
