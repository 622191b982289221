"""Faults in the middle of an ingest: whatever is killed, cut or full, the rows end up as if nothing had been."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import text

from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseUnavailableError, NotFoundError, UsageError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings
from tests import servers, services
from tests.integration.comparison import content, is_complete, rows_per_table, stored
from tests.rooms import COMMAND, environment, render, semdb

SPECS = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}
KILLS = 30
FRAMES = 300
SOME = 60


def settings(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", features="orb", threads=2)


@pytest.fixture(scope="module")
def long_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """300 small frames."""
    options = SyntheticOptions(frames=FRAMES, width=96, height=72, lap_frames=150)
    return render(tmp_path_factory.mktemp("faults") / "room", options)


@pytest.fixture(scope="module")
def undisturbed(long_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """All 300 frames, ingested by one process without any fault."""
    url = f"sqlite:///{tmp_path_factory.mktemp('undisturbed') / 'a.sqlite3'}"
    ingest_recordings([long_room], settings(url), IngestOptions(stride=1, map_name="m"))
    with open_store(url) as store:
        yield store


@pytest.fixture(scope="module")
def some(long_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Store]:
    """Each fifth frame, without any fault."""
    url = f"sqlite:///{tmp_path_factory.mktemp('some') / 'a.sqlite3'}"
    ingest_recordings([long_room], settings(url), IngestOptions(stride=FRAMES // SOME, map_name="m"))
    with open_store(url) as store:
        yield store


def make_schema(url: str) -> None:
    engine = make_engine(url)
    schema.upgrade(engine)
    engine.dispose()


def start_ingest(room: Path, url: str) -> subprocess.Popen[str]:
    command = [*COMMAND, "ingest", str(room), "--stride", str(FRAMES // SOME), "--map", "m", "--json"]
    return subprocess.Popen(
        command, env=environment(url, **SPECS), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_thirty_killed_workers(long_room: Path, undisturbed: Store, any_server_url: str, tmp_path: Path) -> None:
    """Four processes of two workers; most kills take one of the four, some a whole worker."""
    make_schema(any_server_url)
    chance = random.Random(7)
    due = sorted(chance.sample(range(5, FRAMES - 10), KILLS))
    with services.redis(tmp_path) as broker, open_store(any_server_url) as store:
        where = {"SEMDB_BROKER_URL": broker.url, **SPECS}
        queued = semdb("ingest", long_room, "--queue", "--stride", 1, "--map", "m", url=any_server_url, **where)
        assert queued.returncode == 0, queued.stderr

        def worker() -> services.Worker:
            return services.start_worker(tmp_path, any_server_url, broker.url, processes=2, **SPECS)

        def reach(keyframes: int, running: list[services.Worker]) -> None:
            """Waits for so many; as a supervisor, starts workers that have ended and has what they had sent again."""
            while stored(store) < keyframes:
                for place, one in enumerate(running):
                    if one.process.poll() is not None:
                        running[place] = worker()
                        assert semdb("ingest", "--resume", url=any_server_url, **where).returncode == 0
                time.sleep(0.02)

        kills = 0
        with services.workers(worker(), worker()) as running:
            for number, keyframes in enumerate(due):
                reach(keyframes, running)
                victim = chance.choice(running)
                children = victim.children()
                if number % 10 == 9 or not children:
                    victim.kill()
                else:
                    os.kill(chance.choice(children), signal.SIGKILL)
                kills += 1
            reach(FRAMES, running)
            assert kills == KILLS
            services.wait_until(lambda: is_complete(store), "the recording is complete")
        assert content(store) == content(undisturbed)
        assert store.failed_items() == []


def test_the_database_server_is_killed_and_started_again(
    long_room: Path, some: Store, server_kind: servers.Kind
) -> None:
    with servers.server(server_kind, "--innodb-flush-log-at-trx-commit=1") as server:
        make_schema(server.url())
        process = start_ingest(long_room, server.url())
        with open_store(server.url()) as store:
            services.wait_until(lambda: stored(store) >= 10, "10 keyframes")
            server.kill()
            time.sleep(12)  # a server that has much to recover is away longer than ten attempts take
            assert process.poll() is None
            server.start()
            _, errors = process.communicate(timeout=120)
            assert process.returncode == 0, errors
            assert content(store) == content(some)


def test_connections_are_cut(long_room: Path, some: Store, server_url: str) -> None:
    make_schema(server_url)
    done = threading.Event()
    cut: list[int] = []

    def cut_all() -> None:
        engine = make_engine(server_url)
        own = engine.connect()
        schema, own_id = own.execute(text("SELECT DATABASE(), CONNECTION_ID()")).one()
        own.execute(text("SET SESSION character_set_results = binary"))  # statements that are shown hold images
        while not done.wait(0.25):
            listed = own.execute(text("SHOW PROCESSLIST")).all()  # id, user, host, schema, ...
            for number in (row[0] for row in listed if row[3] == schema.encode() and row[0] != own_id):
                try:
                    own.execute(text(f"KILL {number}"))
                    cut.append(number)
                except Exception:  # it has ended by itself meanwhile
                    own.rollback()
            own.rollback()
        own.close()
        engine.dispose()

    thread = threading.Thread(target=cut_all)
    thread.start()
    try:
        ingest_recordings([long_room], settings(server_url), IngestOptions(stride=FRAMES // SOME, map_name="m"))
    finally:
        done.set()
        thread.join()
    assert len(cut) >= 3
    with open_store(server_url) as store:
        assert content(store) == content(some)


def test_the_broker_is_killed_and_comes_back_empty(
    long_room: Path, some: Store, any_server_url: str, tmp_path: Path
) -> None:
    make_schema(any_server_url)
    with services.redis(tmp_path) as broker, open_store(any_server_url) as store:
        where = {"SEMDB_BROKER_URL": broker.url, **SPECS}
        arguments = ("ingest", long_room, "--queue", "--stride", FRAMES // SOME, "--map", "m")
        assert semdb(*arguments, url=any_server_url, **where).returncode == 0
        with services.workers(services.start_worker(tmp_path, any_server_url, broker.url, **SPECS)) as [worker]:
            services.wait_until(lambda: stored(store) >= 5, "5 keyframes")
            broker.kill()
            refused = semdb("ingest", "--resume", url=any_server_url, **where)
            assert refused.returncode == 1
            assert "does not answer" in refused.stderr
            assert "semdb ingest --resume" in refused.stderr
            broker.start()
            assert semdb("ingest", "--resume", url=any_server_url, **where).returncode == 0
            services.wait_until(lambda: is_complete(store), "all are stored")
            worker.process.terminate()
            assert worker.process.wait(30) == 0
        assert content(store) == content(some)


def test_the_disk_of_the_database_is_full(long_room: Path, some: Store, server_kind: servers.Kind) -> None:
    space = "--innodb-data-file-path=ibdata1:12M:autoextend:max:{}M"
    how = ("--innodb-file-per-table=0",)
    with servers.server(server_kind, *how, space.format(18), install_options=(*how, space.format(18))) as server:
        make_schema(server.url())
        with open_store(server.url()) as store:
            fill = IngestOptions(stride=1, map_name="full")
            with pytest.raises(DatabaseUnavailableError, match=r"cannot grow: its disk.*is full"):
                ingest_recordings([long_room], settings(server.url()), fill)
            rows = rows_per_table(store)
            assert 0 < rows["keyframes"] < FRAMES
            assert rows["keyframes"] == rows["descriptors"] == rows["keyframe_images"]  # no half of one
            assert store.failed_items() == []
            server.stop()
            server.options = [o for o in server.options if "data-file-path" not in o] + [space.format(200)]
            server.start()
            [summary] = ingest_recordings([long_room], settings(server.url()), fill)
            assert summary.stored == FRAMES - rows["keyframes"]
            assert is_complete(store)


def deadlocks(url: str) -> int:
    """How many the server has found so far."""
    engine = make_engine(url)
    with engine.connect() as connection:
        query = text("SELECT count FROM information_schema.innodb_metrics WHERE name = 'lock_deadlocks'")
        number = int(connection.execute(query).scalar_one())
    engine.dispose()
    return number


def test_ingest_and_delete_of_one_recording_at_once(long_room: Path, some: Store, server_url: str) -> None:
    """Three writers and two that delete, until 8 deletions are done and writers and deleters have met in a deadlock.

    Then nothing is left, and it can be ingested.
    """
    make_schema(server_url)
    met = deadlocks(server_url)
    options = IngestOptions(stride=FRAMES // SOME, map_name="m")
    end = threading.Event()
    wrong: list[BaseException] = []
    deletions: list[int] = []

    def repeat(work: Callable[[], None]) -> Callable[[], None]:
        def run() -> None:
            while not end.is_set():
                try:
                    work()
                except (NotFoundError, UsageError):  # it is gone, or going
                    continue
                except BaseException as error:
                    wrong.append(error)
                    end.set()

        return run

    def ingest() -> None:
        ingest_recordings([long_room], settings(server_url), options)

    def delete() -> None:
        with open_store(server_url) as store:
            key = store.find_recording(store.find_map("m").id, "room")
            services.wait_until(lambda: end.is_set() or stored(store) >= 3, "keyframes to delete")
            deletions.append(store.delete_recording(key).keyframes)
            if (len(deletions) >= 8 and deadlocks(server_url) > met) or len(deletions) >= 60:
                end.set()

    threads = [threading.Thread(target=repeat(work)) for work in (ingest, ingest, ingest, delete, delete)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert wrong == []
    assert len(deletions) >= 8
    assert deadlocks(server_url) > met, "no deadlock was provoked: the test tests nothing"
    with open_store(server_url) as store:
        for recording in store.status():
            store.delete_recording(recording.recording_id)
        rows = rows_per_table(store)
        assert {rows[name] for name in ("recordings", "ingest_items", "keyframes", "objects", "descriptors")} == {0}
        ingest()
        assert content(store)["frames"] == content(some)["frames"]


def test_two_ingests_at_once_share_the_work(long_room: Path, some: Store, server_url: str) -> None:
    make_schema(server_url)
    processes = [start_ingest(long_room, server_url) for _ in range(2)]
    answers = [process.communicate(timeout=120) for process in processes]
    assert [process.returncode for process in processes] == [0, 0], answers
    summaries = [json.loads(out)[0] for out, _ in answers]
    assert sum(summary["stored"] for summary in summaries) == SOME
    with open_store(server_url) as store:
        assert content(store) == content(some)


def test_a_recording_that_grows(long_room: Path, tmp_path: Path) -> None:
    """Lists get longer, and the last file is half written, while an ingest is under way and before the next one."""
    copy = tmp_path / "room"
    shutil.copytree(long_room, copy)
    lists = {name: (copy / name).read_text().splitlines(keepends=True) for name in ("rgb.txt", "depth.txt")}
    last = copy / lists["rgb.txt"][2 + 40].split()[1]
    whole = last.read_bytes()
    last.write_bytes(whole[: len(whole) // 2])

    def grow(frames: int) -> None:
        for name, lines in lists.items():
            (copy / name).write_text("".join(lines[: 2 + frames]))

    grow(41)
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    options = IngestOptions(stride=2, map_name="m")
    [first] = ingest_recordings(
        [copy], settings(url), options, progress=lambda _what, done, _total: grow(41 + done), say=None
    )
    assert (first.planned, first.stored, first.failed) == (20, 20, {})
    last.write_bytes(whole)
    grow(FRAMES)
    [again] = ingest_recordings([copy], settings(url), IngestOptions(map_name="m"))
    assert (again.planned, again.already_stored, again.stored) == (20, 20, 0)
    [more] = ingest_recordings([copy], settings(url), options)  # as it was asked for: every second frame
    assert (more.planned, more.already_stored, more.failed) == (FRAMES // 2, 20, {})
    with open_store(url) as store:
        assert stored(store) == FRAMES // 2


def test_a_recording_that_grows_under_two_processes(long_room: Path, tmp_path: Path) -> None:
    """One ingests, the recording gets longer, another joins in: the plan is the first one's, each keyframe is once."""
    copy, short = tmp_path / "room", tmp_path / "short"
    shutil.copytree(long_room, copy)
    lists = {name: (copy / name).read_text().splitlines(keepends=True) for name in ("rgb.txt", "depth.txt")}

    def grow(frames: int) -> None:
        for name, lines in lists.items():
            (copy / name).write_text("".join(lines[: 2 + frames]))

    grow(80)
    shutil.copytree(copy, short)
    expected = f"sqlite:///{tmp_path / 'expected.sqlite3'}"
    ingest_recordings([short], settings(expected), IngestOptions(stride=1, map_name="m", name="room"))
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with open_store(url, create=True) as store:
        command = [*COMMAND, "ingest", str(copy), "--map", "m", "--json"]
        given = {"env": environment(url, **SPECS), "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        processes = [subprocess.Popen([*command, "--stride", "1"], **given)]  # type: ignore[call-overload]
        services.wait_until(lambda: stored(store) >= 5, "5 keyframes")
        grow(200)
        processes.append(subprocess.Popen(command, **given))  # type: ignore[call-overload]
        services.wait_until(lambda: stored(store) >= 20, "20 keyframes")
        grow(FRAMES)
        answers = [process.communicate(timeout=120) for process in processes]
        assert [process.returncode for process in processes] == [0, 0], answers
        summaries = [json.loads(out)[0] for out, _ in answers]
        assert [summary["keyframes"] for summary in summaries] == [80, 80]
        assert sum(summary["stored"] for summary in summaries) == 80
        assert is_complete(store)
        with open_store(expected) as undisturbed:
            assert content(store) == content(undisturbed)


@pytest.mark.parametrize("position", range(6))
def test_a_broken_frame_in_each_position(long_room: Path, tmp_path: Path, position: int) -> None:
    copy = tmp_path / "room"
    copy.mkdir()
    for name in ("rgb", "depth", "masks"):
        (copy / name).mkdir()
        for file in sorted((long_room / name).iterdir())[: 6 if name != "masks" else None]:
            shutil.copy(file, copy / name / file.name)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (long_room / name).read_text().splitlines(keepends=True)
        (copy / name).write_text("".join(lines[:8]))
    shutil.copy(long_room / "camera.json", copy)
    kind = ("rgb", "depth", "masks")[position % 3]
    broken = sorted((copy / kind).glob("*.png"))[position]
    data = bytearray(broken.read_bytes())
    data[len(data) // 2] ^= 0xFF  # header and end are whole
    broken.write_bytes(data)
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    [summary] = ingest_recordings([copy], settings(url), IngestOptions(stride=1, map_name="m"))
    assert list(summary.failed) == [position]
    assert broken.name in summary.failed[position]
    assert summary.stored == 5
    with open_store(url) as store:
        assert [row[0] for row in content(store)["frames"]] == [k for k in range(6) if k != position]
        assert is_complete(store)
