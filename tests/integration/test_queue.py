"""Planning for workers and doing what messages say, without a broker; recordings behind URLs; mounts that are lost."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import fsspec
import pytest

from semdb.cli.status import Rates
from semdb.database import items
from semdb.database.items import OpenItem, open_items
from semdb.database.reporting import workers
from semdb.database.retry import MAY_HEAL, task_delay_s
from semdb.database.store import Store, open_store
from semdb.errors import ProvenanceError, RecordingError, RecordingUnavailableError, UsageError
from semdb.ingestion.queue import CHUNK, Workplace, parts, queue_recordings, sweep
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings.options import ReadOptions
from semdb.recordings.source import Source, fetch, parse_source, write_source
from semdb.settings import Settings
from semdb.types import Camera
from tests.integration.comparison import content

Message = tuple[int, str, tuple[int, ...]]


class Outbox(list[Message]):
    """Messages that were sent."""

    def send(self, recording_id: int, source: str, frames: Sequence[int]) -> None:
        self.append((recording_id, source, tuple(frames)))


def settings(url: str, cache: Path) -> Settings:
    made = {"detector": "recorded", "encoder": "gist", "features": "orb", "threads": 2}
    return Settings(database_url=url, cache_dir=cache, **made)  # type: ignore[arg-type]


@pytest.fixture
def expected(room: Path, tmp_path: Path) -> Iterator[Store]:
    """All 24 frames, ingested in one go."""
    url = f"sqlite:///{tmp_path / 'expected.sqlite3'}"
    ingest_recordings([room], settings(url, tmp_path), IngestOptions(stride=1, map_name="m"))
    with open_store(url) as store:
        yield store


def test_messages_in_any_order_and_twice(room: Path, expected: Store, database_url: str, tmp_path: Path) -> None:
    outbox, own = Outbox(), settings(database_url, tmp_path)
    [summary] = queue_recordings([str(room)], own, IngestOptions(stride=1, map_name="m"), outbox.send)
    assert (summary.planned, summary.stored) == (24, 0)
    assert [len(frames) for _, _, frames in outbox] == [CHUNK, 24 - CHUNK]
    with open_store(database_url) as store:
        assert sweep(store, outbox.send) == 0  # they are on their way
        assert sweep(store, outbox.send, all_pending=True) == 24
    place = Workplace(own)
    outcomes = [place.do(*message) for message in reversed(outbox)]
    assert [outcome.stored for outcome in outcomes] == [24 - CHUNK, CHUNK, 0, 0]
    assert [outcome.complete for outcome in outcomes] == [False, True, True, True]
    with open_store(database_url) as store:
        frames = content(store)["frames"]
        assert frames == content(expected)["frames"]


def test_a_worker_that_is_to_stop_finishes_what_it_is_at(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    outbox, own = Outbox(), settings(url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=1, map_name="m"), outbox.send)
    done: list[int] = []
    outcome = Workplace(own).do(*outbox[0], stop=lambda: bool(done), note=lambda item: done.append(1))
    assert 1 <= outcome.stored < CHUNK
    assert outcome.stored == len(done)
    assert len(outcome.left) == CHUNK - outcome.stored
    with open_store(url) as store:
        assert items.left(store.engine, 1) == (24 - outcome.stored, 0)  # nothing is held any more
        assert workers(store.engine) == []


def test_a_lost_mount_is_waited_for_and_a_deleted_recording_is_not(room: Path, tmp_path: Path) -> None:
    url, away, mount = f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "away", tmp_path / "mount"
    mount.symlink_to(room)
    outbox, own = Outbox(), settings(url, tmp_path)
    queue_recordings([str(mount)], own, IngestOptions(stride=4, map_name="m"), outbox.send)
    mount.rename(away)
    place = Workplace(own)
    with pytest.raises(RecordingUnavailableError, match="no such folder or file on this machine") as caught:
        place.do(*outbox[0])
    assert isinstance(caught.value, MAY_HEAL)
    with open_store(url) as store:
        assert items.left(store.engine, 1) == (6, 0)
        assert store.failed_items() == []
        away.rename(mount)
        assert place.do(*outbox[0]).stored == 6
        store.delete_recording(1)
    assert place.do(*outbox[0]).stored == 0


def test_a_doubled_message_of_a_finished_recording_needs_no_folder(room: Path, tmp_path: Path) -> None:
    url, mount = f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "mount"
    mount.symlink_to(room)
    outbox, own = Outbox(), settings(url, tmp_path)
    queue_recordings([str(mount)], own, IngestOptions(stride=4, map_name="m"), outbox.send)
    assert Workplace(own).do(*outbox[0]).stored == 6
    mount.unlink()
    again = Workplace(own).do(*outbox[0])
    assert (again.stored, again.left, again.held, again.complete, again.gone) == (0, (), (), True, False)
    with open_store(url) as store:
        store.delete_recording(1)
    assert Workplace(own).do(*outbox[0]).gone


def test_a_claim_whose_answer_was_lost_strands_nothing(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The transaction is run again, and takes others than those that it has taken unknowingly."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    outbox, own = Outbox(), settings(url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=1, map_name="m"), outbox.send)
    claim, unanswered = items.claim, []

    def twice(*given: Any, **named: Any) -> list[items.Claim]:
        if not unanswered:
            unanswered.extend(claim(*given, **named))
        return claim(*given, **named)

    monkeypatch.setattr(items, "claim", twice)
    outcome = Workplace(own).do(*outbox[0])
    assert len(unanswered) >= 3
    assert (outcome.stored, outcome.left, outcome.held) == (CHUNK, (), ())
    with open_store(url) as store:
        assert items.left(store.engine, 1) == (24 - CHUNK, 0)


def test_what_another_worker_is_at_is_not_taken_for_done(room: Path, database_url: str, tmp_path: Path) -> None:
    outbox, own = Outbox(), settings(database_url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=1, map_name="m"), outbox.send)
    with open_store(database_url) as store:
        items.claim(store.engine, 1, "elsewhere!1!2!3!a", limit=2)
        outcome = Workplace(own).do(*outbox[0])
        assert (outcome.stored, outcome.left, outcome.held) == (CHUNK - 2, (), (0, 1))
        assert open_items(store.engine, 1, outbox[0][2]) == [OpenItem(0, 1, True), OpenItem(1, 1, True)]
        items.renew(store.engine, 1, "elsewhere!1!2!3!a", lease_s=-5)
        assert Workplace(own).do(*outbox[0]).stored == 2


def test_what_was_begun_before_is_done_alone_and_last() -> None:
    found = [OpenItem(1, 3, False), OpenItem(2, 0, False), OpenItem(3, 1, False), OpenItem(4, 0, False)]
    assert parts([*found, OpenItem(5, 0, True)]) == [(2, 4), (3,), (1,)]
    assert parts([OpenItem(5, 1, True)]) == []


def test_a_worker_with_other_models_claims_nothing(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    outbox, own = Outbox(), settings(url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=4, map_name="m"), outbox.send)
    other = own.model_copy(update={"features": "sift"})
    with pytest.raises(ProvenanceError, match="not by sift"):
        Workplace(other).do(*outbox[0])
    with open_store(url) as store:
        assert [item.attempts for item in open_items(store.engine, 1, outbox[0][2])] == [0] * 6


def test_keyframes_whose_message_was_not_sent_are_sent_by_the_next_sweep(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    outbox, own = Outbox(), settings(url, tmp_path)

    def refuse(*_: object) -> None:
        raise OSError("the broker is gone")

    with pytest.raises(OSError, match="gone"):
        queue_recordings([str(room)], own, IngestOptions(stride=1, map_name="m"), refuse)
    time.sleep(1.1)  # times of the database are whole seconds
    with open_store(url) as store:
        assert sweep(store, outbox.send) == 24


def test_pauses_between_tasks_grow_up_to_a_limit() -> None:
    pauses = [task_delay_s(retries) for retries in range(12)]
    assert 1.0 <= pauses[0] <= 2.0
    assert 150 <= pauses[-1] <= 300
    assert task_delay_s(10_000) <= 300


@pytest.mark.parametrize("kind", ["file", "memory"])
def test_a_recording_behind_a_url(room: Path, expected: Store, tmp_path: Path, kind: str) -> None:
    address = f"file://{room}"
    if kind == "memory":
        address = f"memory://{tmp_path.name}/room"
        system = fsspec.filesystem("memory")
        for path in sorted(room.rglob("*")):
            if path.is_file():
                system.pipe(f"/{tmp_path.name}/room/{path.relative_to(room)}", path.read_bytes())
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    outbox, own = Outbox(), settings(url, tmp_path / "cache")
    [summary] = queue_recordings([address], own, IngestOptions(stride=1, map_name="m"), outbox.send)
    assert summary.recording == "room"
    assert {source for _, source, _ in outbox} == {address}
    place = Workplace(settings(url, tmp_path / "another machine"))
    assert sum(place.do(*message).stored for message in outbox) == 24
    with open_store(url) as store:
        assert content(store) == content(expected)
        assert store.status()[0].source == address


def test_only_what_is_missing_is_fetched(room: Path, tmp_path: Path) -> None:
    folder = fetch(f"file://{room}", tmp_path)
    images = sorted((folder / "rgb").iterdir())
    assert [path.read_bytes() for path in images] == [path.read_bytes() for path in sorted((room / "rgb").iterdir())]
    before = images[1].stat().st_mtime_ns
    images[0].write_bytes(b"half")
    fetch(f"file://{room}", tmp_path)
    assert images[0].read_bytes() == (room / "rgb" / images[0].name).read_bytes()
    assert images[1].stat().st_mtime_ns == before


def test_urls_that_lead_nowhere(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="there is nothing there"):
        fetch("memory://nothing/here", tmp_path)
    with pytest.raises(UsageError, match="no-such-system"):
        fetch("no-such-system://room", tmp_path)


def test_a_camera_that_was_given_travels_with_the_source() -> None:
    source = parse_source(write_source("s3://bucket/room", "500,510,320,240"))
    assert (source.address, source.parsed_camera) == ("s3://bucket/room", Camera(0, 0, 500, 510, 320, 240))
    assert source.options == ReadOptions()
    assert parse_source("/data/room") == Source("/data/room")


def test_how_a_recording_is_read_travels_with_the_source() -> None:
    options = ReadOptions(depth_scale=1000, poses_are="camera_from_world", color_topic="/a b/c&d?", time_offset_ms=-0.1)
    for camera in (None, "500,510,320,240"):
        written = write_source("/data/what?/room", camera, options)
        assert parse_source(written) == Source("/data/what?/room", camera, options)
    assert write_source("/data/room", None, ReadOptions(scale=2.0)) == "/data/room?scale=2.0"


def test_rates_of_the_last_looks() -> None:
    rates = Rates(window_s=10)
    rates.look({1: 5}, now_s=100)
    assert rates.per_second(1) is None
    rates.look({1: 25, 2: 3}, now_s=104)
    assert rates.per_second(1) == 5.0
    assert rates.per_second(2) is None
    rates.look({1: 25, 2: 3}, now_s=113)
    assert rates.per_second(1) == 0.0
