"""A writer that stores a keyframe while its recording is deleted: each keyframe that was added is logged as deleted."""

from __future__ import annotations

import threading
from typing import Any

import pytest
from sqlalchemy import event

from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.records import ChangeKind, WriteResult
from semdb.database.store import Store, open_store
from semdb.errors import NotFoundError
from tests.database_samples import MODELS, description, fill, plan, record


class Writer:
    """Stores frame 2 in a thread of its own, when it is told to, and waits before the last statement."""

    def __init__(self, store: Store, recording_id: int) -> None:
        self.outcome: WriteResult | NotFoundError | None = None
        self._store, self._recording_id = store, recording_id
        self._at_last, self.may_end = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run)
        event.listen(store.engine, "before_cursor_execute", self._hold)

    def begin(self) -> None:
        """Returns when it is about to end, or was refused."""
        self._thread.start()
        assert self._at_last.wait(20)

    def end(self) -> WriteResult | NotFoundError | None:
        self.may_end.set()
        self._thread.join(20)
        return self.outcome

    def _hold(self, _connection: Any, _cursor: Any, statement: str, *_more: Any) -> None:
        if statement.startswith("INSERT INTO keyframe_changes "):
            self._at_last.set()
            assert self.may_end.wait(20)

    def _run(self) -> None:
        try:
            self.outcome = self._store.write_keyframe(self._recording_id, record(2, description(2)))
        except NotFoundError as error:
            self.outcome = error
        finally:
            self._at_last.set()


@pytest.mark.parametrize("during_statement", [True, False])
@pytest.mark.parametrize("table", ["keyframes", "ingest_items", "recordings"])
def test_no_keyframe_goes_without_a_trace(server_url: str, table: str, during_statement: bool) -> None:
    """The writer begins right before rows of `table` are deleted; it ends before that, or while that statement runs."""
    schema.upgrade(make_engine(server_url))
    with open_store(server_url) as store, open_store(server_url) as other:
        map_id, kept, ids = fill(store, name="another")  # of the same camera, which so stays
        recording_id = store.plan_recording(map_id, plan("r", [1, 2]), MODELS).recording_id
        assert other.write_keyframe(recording_id, record(1, description(1))).created  # it remembers the recording
        writer = Writer(other, recording_id)
        begun: list[str] = []

        @event.listens_for(store.engine, "before_cursor_execute")
        def _interfere(_connection: Any, _cursor: Any, statement: str, *_more: Any) -> None:
            if not begun and statement.startswith(f"DELETE FROM {table} "):
                begun.append(statement)
                writer.begin()
                if during_statement:
                    threading.Timer(0.5, writer.may_end.set).start()
                else:
                    writer.end()

        deleted = store.delete_recording(recording_id)
        outcome = writer.end()
        assert len(begun) == 1
        changes = store.changes_since(map_id, 0)
        assert store.keyframe_ids(map_id) == ids
        assert [status.recording_id for status in store.status()] == [kept]
    kinds = {kind: {change.keyframe_id for change in changes if change.kind == kind} for kind in ChangeKind}
    assert kinds[ChangeKind.ADDED] == kinds[ChangeKind.DELETED] | set(ids)
    assert len(kinds[ChangeKind.DELETED]) == deleted.keyframes == (2 if isinstance(outcome, WriteResult) else 1)
    assert isinstance(outcome, NotFoundError if table == "recordings" else WriteResult)
