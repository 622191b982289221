"""Workers that are wrong, hang, are told to stop, or find their port taken: no keyframe is left without a message."""

from __future__ import annotations

import json
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import update

from semdb.database import items
from semdb.database.items import open_items, unsent
from semdb.database.store import Store, open_store
from semdb.database.tables import ingest_items
from semdb.ingestion.queue import queue_recordings
from semdb.ingestion.run import IngestOptions, ingest_recordings, make_describers
from semdb.ingestion.work import work_off
from semdb.perception.describe import Describer
from semdb.perception.model_choice import ModelSpecs
from semdb.recordings import open_recordings
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings
from semdb.workers import INGEST_TASK, make_app
from tests import services
from tests.integration.comparison import content, is_complete, stored
from tests.integration.test_queue import Outbox, settings
from tests.rooms import render, semdb

SPECS = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}
FRAMES = 20
OPTIONS = ("--queue", "--stride", 1, "--map", "m")
# A worker with other limits, or slower, than the real one: what is changed before its tasks are made.
WORKER = """
import sys, time
import semdb.workers
from celery.__main__ import main
{change}
sys.argv = ["celery", "--app", "semdb.workers", "worker", "--concurrency", "1", "--loglevel", "info",
            "--without-gossip", "--without-mingle"]
main()
"""
HANGS = """
import pathlib
import semdb.ingestion.work as work
semdb.workers.SOFT_LIMIT_S, semdb.workers.HARD_LIMIT_S = 2, 3
read, healed = work._read, pathlib.Path({healed!r})
def hang(recording, item):
    while item.claim.frame_index == 3 and not healed.exists():
        time.sleep(0.05)
    return read(recording, item)
work._read = hang
"""
SLOW = """
import semdb.ingestion.work as work
read = work._read
work._read = lambda *given: (time.sleep(0.4), read(*given))[1]
"""


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 small frames."""
    options = SyntheticOptions(frames=FRAMES, width=96, height=72, lap_frames=60)
    return render(tmp_path_factory.mktemp("workers") / "room", options)


@pytest.fixture(scope="module")
def undisturbed(small: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """All frames, ingested by one process without any fault."""
    folder = tmp_path_factory.mktemp("undisturbed")
    url = f"sqlite:///{folder / 'a.sqlite3'}"
    ingest_recordings([small], settings(url, folder), IngestOptions(stride=1, map_name="m"))
    with open_store(url) as store:
        yield store


def start(folder: Path, database_url: str, broker_url: str, change: str = "", **given: str) -> services.Worker:
    """A worker with one process, changed by a line of Python."""
    command = [sys.executable, "-c", WORKER.format(change=change)]
    return services.start(command, folder, database_url, broker_url, **(SPECS | given))


def queue(room: Path, url: str, broker: services.Redis) -> None:
    done = semdb("ingest", room, *OPTIONS, url=url, SEMDB_BROKER_URL=broker.url, **SPECS)
    assert done.returncode == 0, done.stderr


def test_a_worker_with_other_models_leaves_the_work_to_others(small: Path, undisturbed: Store, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with services.redis(tmp_path) as broker:
        queue(small, url, broker)
        wrong = start(tmp_path, url, broker.url, SEMDB_FEATURES="sift")
        with services.workers(wrong) as running, open_store(url) as store:
            services.wait_until(lambda: wrong.text().count("refused recording=1") >= 2, "it has refused two messages")
            assert "ProvenanceError: the map is described by the features orb" in wrong.text()
            assert [item.attempts for item in open_items(store.engine, 1, range(FRAMES))] == [0] * FRAMES
            running.append(start(tmp_path, url, broker.url))
            services.wait_until(lambda: is_complete(store), "the other worker does all")
            assert content(store) == content(undisturbed)
            assert store.failed_items() == []
            wrong.process.terminate()  # in the middle of a pause
            assert wrong.process.wait(20) == 0


def test_a_worker_that_may_not_into_the_database_leaves_the_work_to_others(
    small: Path, undisturbed: Store, any_server_url: str, tmp_path: Path
) -> None:
    assert semdb("init", url=any_server_url).returncode == 0
    host = any_server_url.partition("@")[2]
    with services.redis(tmp_path) as broker:
        queue(small, any_server_url, broker)
        wrong = start(tmp_path, f"mysql+pymysql://nobody:outdated@{host}", broker.url)
        with services.workers(wrong) as running, open_store(any_server_url) as store:
            services.wait_until(lambda: wrong.text().count("refused recording=1") >= 2, "it has refused two messages")
            assert "refuses: check user, password" in wrong.text()
            running.append(start(tmp_path, any_server_url, broker.url))
            services.wait_until(lambda: is_complete(store), "the other worker does all")
            assert content(store) == content(undisturbed)


def test_a_read_that_hangs_loses_nothing_and_holds_up_nothing(small: Path, undisturbed: Store, tmp_path: Path) -> None:
    """Its process is killed at the hard limit, and the message comes back; the second time others go first."""
    url, healed = f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "healed"
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        queue(small, url, broker)
        with services.workers(start(tmp_path, url, broker.url, HANGS.format(healed=str(healed)))) as [worker]:
            services.wait_until(lambda: stored(store) == FRAMES - 1, "all others are stored")
            services.wait_until(
                lambda: worker.text().count("Hard time limit (3s) exceeded") >= 2, "it was killed twice"
            )
            [left] = open_items(store.engine, 1, range(FRAMES))
            assert left.frame_index == 3
            healed.touch()
            services.wait_until(lambda: is_complete(store), "what hung is stored")
        assert store.failed_items() == []
        assert content(store) == content(undisturbed)


def test_a_read_that_hangs_for_ever_fails_alone(small: Path, tmp_path: Path) -> None:
    """The keyframe is given up after so many tries; here all but one of them are over."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        queue(small, url, broker)
        with store.engine.begin() as connection:
            tries = update(ingest_items).where(ingest_items.c.frame_index == 3)
            connection.execute(tries.values(attempts=items.MOST_ATTEMPTS - 1))
        with services.workers(start(tmp_path, url, broker.url, HANGS.format(healed=str(tmp_path / "never")))):
            services.wait_until(lambda: is_complete(store), "the recording is complete")
        [failed] = store.failed_items()
        assert (failed.frame_index, stored(store)) == (3, FRAMES - 1)
        assert "died or was lost 10 times" in failed.error


def test_a_worker_that_starts_sends_what_is_lost(small: Path, undisturbed: Store, tmp_path: Path) -> None:
    """No message: some were sent long ago, some are held by a machine that is gone, one has been sent just now."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    queue_recordings([str(small)], settings(url, tmp_path), IngestOptions(stride=1, map_name="m"), Outbox().send)
    with services.redis(tmp_path) as broker, open_store(url) as store:
        items.mark_sent(store.engine, 1, range(FRAMES - 1), -5)
        items.claim(store.engine, 1, "gone!1!2!3!a", limit=4, lease_s=-5)
        assert unsent(store.engine) == FRAMES - 1 - 4
        shown = semdb("status", url=url, SEMDB_BROKER_URL=broker.url).stdout
        assert f"{FRAMES - 5} keyframes wait for which no message is known to be on its way" in shown
        with services.workers(start(tmp_path, url, broker.url)) as [worker]:
            services.wait_until(lambda: stored(store) == FRAMES - 1, "all that was lost is stored")
            assert f"sweep sent={FRAMES - 1}" in worker.text()
            time.sleep(0.5)
            assert [item.frame_index for item in open_items(store.engine, 1, range(FRAMES))] == [FRAMES - 1]
            assert unsent(store.engine) == 0  # its message is thought to be on its way
            resumed = semdb("ingest", "--resume", "--json", url=url, SEMDB_BROKER_URL=broker.url)
            assert json.loads(resumed.stdout) == {"sent": 1}
            services.wait_until(lambda: is_complete(store), "the last one is stored")
        assert content(store) == content(undisturbed)


def test_a_busy_worker_that_is_told_to_stop_gives_back_what_it_has_not_begun(
    small: Path, undisturbed: Store, tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        queue(small, url, broker)
        with services.workers(start(tmp_path, url, broker.url, SLOW)) as running:
            services.wait_until(lambda: stored(store) >= 2, "it is busy")
            assert sum(items.left(store.engine, 1)) >= 10
            running[0].process.terminate()
            assert running[0].process.wait(20) == 0
            done = stored(store)
            assert 2 <= done <= 8  # the keyframes of its claim at most
            assert items.left(store.engine, 1) == (FRAMES - done, 0)
            assert store.failed_items() == []
            running.append(start(tmp_path, url, broker.url))  # no keyframe is due to be swept: messages name them
            services.wait_until(lambda: is_complete(store), "another worker does the rest")
            assert "sweep sent=0" in running[1].text()
        assert content(store) == content(undisturbed)


class Slow(Describer):
    """Describes after a while."""

    def describe(self, *given: object, **named: object) -> object:  # type: ignore[override]
        time.sleep(2.2)
        return super().describe(*given, **named)  # type: ignore[arg-type]


def test_leases_are_renewed_while_a_keyframe_takes_long(small: Path, database_url: str, tmp_path: Path) -> None:
    """One keyframe takes longer than a lease, which begins for both when they are claimed."""
    own = settings(database_url, tmp_path).model_copy(update={"threads": 1})
    queue_recordings([str(small)], own, IngestOptions(stride=10, map_name="m"), Outbox().send)
    [describer] = make_describers(ModelSpecs("recorded", "gist", "orb"), own)
    slow = Slow.__new__(Slow)
    slow.__dict__.update(vars(describer))
    taken: list[items.Claim] = []
    end = threading.Event()
    [recording] = open_recordings(small)
    with open_store(database_url) as store, open_store(database_url) as other:

        def thief() -> None:
            services.wait_until(lambda: items.left(other.engine, 1)[1] > 0, "some are claimed")
            while not end.wait(0.2):
                held = [item.frame_index for item in open_items(other.engine, 1, (0, 10)) if item.attempts]
                taken.extend(items.claim(other.engine, 1, "thief!1!2!3!a", limit=9, frames=held) if held else [])

        thread = threading.Thread(target=thief)
        thread.start()
        try:
            done = list(work_off(recording, 1, store, [slow], lease_s=2))
        finally:
            end.set()
            thread.join()
        assert taken == []
        assert [(item.claim.frame_index, item.claim.token, item.created) for item in done] == [
            (index, 1, True) for index in (0, 10)
        ]
        assert stored(store) == 2


def test_the_task_of_a_whole_recording_waits_for_it_and_leaves_it_to_all(
    small: Path, undisturbed: Store, tmp_path: Path
) -> None:
    url, mount = f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "mount" / "room"
    mount.parent.mkdir()
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        application = make_app(Settings(broker_url=broker.url))
        application.send_task(INGEST_TASK, args=[str(mount), "m"], kwargs={"options": {"stride": 1}})
        with services.workers(start(tmp_path, url, broker.url)) as [worker]:
            services.wait_until(lambda: f"retry path={mount}" in worker.text(), "it was tried in vain")
            mount.symlink_to(small)
            services.wait_until(lambda: is_complete(store), "the recording is complete")
            services.wait_until(lambda: worker.text().count("succeeded in") == 3, "a plan and two parts of it")
        assert content(store) == content(undisturbed)


def test_a_port_of_metrics_that_is_taken_is_said_and_nothing_else(small: Path, tmp_path: Path) -> None:
    url, temporary = f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "temporary"
    temporary.mkdir()
    queue_recordings([str(small)], settings(url, tmp_path), IngestOptions(stride=5, map_name="m"), Outbox().send)
    with services.redis(tmp_path) as broker, socket.socket() as other, open_store(url) as store:
        other.bind(("0.0.0.0", 0))
        other.listen()
        items.mark_sent(store.engine, 1, range(FRAMES), -5)
        port = other.getsockname()[1]
        worker = start(tmp_path, url, broker.url, SEMDB_METRICS_PORT=str(port), TMPDIR=str(temporary))
        with services.workers(worker):
            services.wait_until(lambda: is_complete(store), "what was lost is swept and done")
            services.wait_until(lambda: f"metrics port={port}" in worker.text(), "it is said")
            assert "not served: [Errno 98]" in worker.text()
            assert "Traceback" not in worker.text()
            assert list(temporary.glob("semdb-metrics-*")) != []
            worker.process.terminate()
            assert worker.process.wait(20) == 0
        assert list(temporary.iterdir()) == []
