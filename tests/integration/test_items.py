"""Claims of keyframes: leases, tokens, what happens when a worker dies or comes back."""

from __future__ import annotations

import subprocess
import sys

import pytest
from sqlalchemy import update

from semdb.database import items
from semdb.database.clock import now_plus
from semdb.database.items import MOST_ATTEMPTS, Claim, claim
from semdb.database.store import Store
from semdb.database.tables import ingest_items
from semdb.errors import LeaseLostError, NotFoundError
from tests.database_samples import MODELS, description, plan, record
from tests.integration.comparison import rows_per_table

FRAMES = (1, 2, 3, 5, 8)


@pytest.fixture
def recording(store: Store) -> int:
    return store.plan_recording(store.ensure_map("room"), plan("r", FRAMES), MODELS).recording_id


def expire(store: Store, recording: int) -> None:
    """All leases have run out a while ago."""
    with store.engine.begin() as connection:
        where = (ingest_items.c.recording_id == recording, ingest_items.c.state == "running")
        connection.execute(update(ingest_items).where(*where).values(lease_until=now_plus(-5)))


def test_two_workers_never_hold_the_same(store: Store, recording: int) -> None:
    one = claim(store.engine, recording, "one", limit=3)
    two = claim(store.engine, recording, "two", limit=3)
    assert one == [Claim(1, 1), Claim(2, 1), Claim(3, 1)]
    assert two == [Claim(5, 1), Claim(8, 1)]
    assert claim(store.engine, recording, "three", limit=3) == []
    assert items.left(store.engine, recording) == (0, 5)


def test_only_the_frames_of_a_message_are_claimed(store: Store, recording: int) -> None:
    assert claim(store.engine, recording, "one", limit=9, frames=[2, 8, 100]) == [Claim(2, 1), Claim(8, 1)]


def test_a_lease_that_ran_out_is_taken_over_and_its_token_is_worth_nothing(store: Store, recording: int) -> None:
    [old] = claim(store.engine, recording, "slow", limit=1)
    expire(store, recording)
    [new] = claim(store.engine, recording, "quick", limit=1)
    assert (old, new) == (Claim(1, 1), Claim(1, 2))
    with pytest.raises(LeaseLostError, match="frame 1 of the recording"):
        store.write_keyframe(recording, record(1, description(1)), old)
    assert not items.fail(store.engine, recording, old, "it was me")
    assert rows_per_table(store)["keyframes"] == 0
    assert store.write_keyframe(recording, record(1, description(1)), new).created
    assert store.write_keyframe(recording, record(1, description(1)), new).created  # its answer was lost: the same
    assert not store.write_keyframe(recording, record(1, description(1)), old).created
    assert rows_per_table(store)["keyframes"] == 1
    assert store.failed_items(recording) == []


def test_a_lease_that_is_renewed_stays(store: Store, recording: int) -> None:
    claim(store.engine, recording, "alive", limit=5)
    expire(store, recording)
    assert items.renew(store.engine, recording, "alive") == 5
    assert claim(store.engine, recording, "other", limit=5) == []
    assert items.release(store.engine, recording, "alive") == 5
    assert items.left(store.engine, recording) == (5, 0)


def test_a_worker_of_this_machine_that_died_is_not_waited_for(store: Store, recording: int) -> None:
    code = "from semdb.database.items import worker_name; print(worker_name())"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert items.worker_is_gone(ended)
    assert not items.worker_is_gone(items.worker_name())
    assert not items.worker_is_gone("somewhere-else!1!2!3!abc")
    assert len(ended) <= ingest_items.c.worker.type.length  # type: ignore[attr-defined]
    claim(store.engine, recording, ended, limit=2)
    claim(store.engine, recording, items.worker_name(), limit=1)
    assert items.release_dead(store.engine, recording) == 2
    assert items.left(store.engine, recording) == (4, 1)


def test_a_worker_is_only_gone_where_that_can_be_known(monkeypatch: pytest.MonkeyPatch) -> None:
    host, space = items._machine()
    start, _, table = space.partition(".")
    assert len(start) == 12
    assert table.isdigit()
    assert items.worker_is_gone(f"{host}!{space}!{2**22 + 1}!77!abc")
    # A machine of the same name whose first table of processes has the same number, as all have.
    assert not items.worker_is_gone(f"{host}!{'0' * 12}.{table}!{2**22 + 1}!77!abc")
    assert not items.worker_is_gone(f"{host}!{table}!{2**22 + 1}!77!abc")  # as older versions wrote it
    monkeypatch.setattr(items, "_machine", lambda: (host, ""))  # no /proc
    assert not items.worker_is_gone(f"{host}!!{2**22 + 1}!77!abc")


def test_a_keyframe_that_kills_its_workers_fails_in_the_end(store: Store, recording: int) -> None:
    for number in range(MOST_ATTEMPTS):
        assert claim(store.engine, recording, f"w{number}", limit=1, frames=[1]) == [Claim(1, number + 1)]
        expire(store, recording)
    assert claim(store.engine, recording, "last", limit=1, frames=[1]) == []
    [failed] = store.failed_items(recording)
    assert (failed.frame_index, failed.attempts) == (1, MOST_ATTEMPTS)
    assert "died or was lost 10 times" in failed.error


def test_what_is_lost_is_sent_once(store: Store, recording: int) -> None:
    [queued] = items.lost(store.engine)
    assert (queued.recording_id, queued.source, queued.frame_indexes) == (recording, "recordings/r", FRAMES)
    items.mark_sent(store.engine, recording, FRAMES, 600)
    assert items.lost(store.engine) == []
    assert items.lost(store.engine, all_pending=True)[0].frame_indexes == FRAMES
    claim(store.engine, recording, "one", limit=2)
    assert items.lost(store.engine, all_pending=True)[0].frame_indexes == (3, 5, 8)
    expire(store, recording)
    assert items.lost(store.engine)[0].frame_indexes == (1, 2)


def test_a_deleted_recording_takes_no_keyframe(store: Store, recording: int) -> None:
    [claimed] = claim(store.engine, recording, "one", limit=1)
    store.delete_recording(recording)
    with pytest.raises(NotFoundError, match="was deleted"):
        store.write_keyframe(recording, record(1, description(1)), claimed)
    assert rows_per_table(store)["keyframes"] == 0
