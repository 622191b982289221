"""A cluster of three nodes on loopback: ingest through all of them, one killed, one back and equal.

Group replication of MySQL, where one node takes writes and another is elected. Galera's is in test_galera.py.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from sqlalchemy import text

from semdb.database import retry, schema
from semdb.database.engine import make_engine
from semdb.database.hosts import MEMBERS_TABLE
from semdb.database.inspection import server_facts
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings
from tests import clusters, services
from tests.integration.comparison import content, is_complete, rows_per_table, stored
from tests.rooms import render, semdb

LONGEST_GAP_S = 30.0
FRAMES = 120
OPTIONS = IngestOptions(stride=1, map_name="m")
SPECS = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}


def settings(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", features="orb", threads=1)


def small_room(folder: Path) -> Path:
    return render(folder / "room", SyntheticOptions(frames=FRAMES, width=96, height=72, lap_frames=90))


@contextlib.contextmanager
def ingested(room: Path, folder: Path) -> Iterator[Store]:
    """All frames, ingested without any fault."""
    url = f"sqlite:///{folder / 'a.sqlite3'}"
    ingest_recordings([room], settings(url), OPTIONS)
    with open_store(url) as store:
        yield store


@pytest.fixture
def group(request: pytest.FixtureRequest, needs_mysql: None) -> Iterator[clusters.Group]:
    """Nodes that leave a dead one at once, or with other options where a test is parametrised."""
    with clusters.group(*getattr(request, "param", ("--loose-group-replication-member-expel-timeout=0",))) as made:
        make_schema(made)
        yield made


def make_schema(cluster: clusters.Cluster) -> None:
    engine = make_engine(cluster.url(1))
    schema.upgrade(engine)
    engine.dispose()


@dataclass
class Watch:
    """Writes and reads what was written, all the time: how long nobody could, and what was not as it should be."""

    url: str
    gaps: list[float] = field(default_factory=list)
    wrong: list[BaseException] = field(default_factory=list)
    ended: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        beat = text("INSERT IGNORE INTO beats VALUES (:number)")
        newest = text("SELECT MAX(number) FROM beats")
        last, number = time.monotonic(), 0
        with open_store(self.url) as store:
            while not self.ended.is_set():
                number += 1
                row = {"number": number}
                try:
                    retry.write(store.engine, lambda c, row=row: c.execute(beat, row))
                    found = retry.read(store.engine, lambda c: c.execute(newest).scalar())
                except DatabaseError:
                    continue
                if found != number:
                    self.wrong.append(AssertionError(f"wrote {number}, read {found}"))
                self.gaps.append(time.monotonic() - last)
                last = time.monotonic()
                time.sleep(0.02)
        self.gaps.append(time.monotonic() - last)  # that it cannot to this day is a gap, too


@contextlib.contextmanager
def watched(cluster: clusters.Cluster, first: int) -> Iterator[Watch]:
    """Watches what a client sees that has one node first in its list."""
    cluster.nodes[0].execute("CREATE TABLE semdb.beats (number INT PRIMARY KEY)")
    watch = Watch(cluster.url(first))
    thread = threading.Thread(target=watch.run)
    thread.start()
    try:
        yield watch
    finally:
        watch.ended.set()
        thread.join(60)
    assert watch.wrong == []
    assert len(watch.gaps) > 20


@contextlib.contextmanager
def ingesting(cluster: clusters.Cluster, room: Path) -> Iterator[list[BaseException]]:
    """Three ingests of one recording, each with another node first; yields what ended them, and waits for them."""
    wrong: list[BaseException] = []

    def ingest(first: int) -> None:
        try:
            ingest_recordings([room], settings(cluster.url(first)), OPTIONS)
        except BaseException as error:
            wrong.append(error)

    threads = [threading.Thread(target=ingest, args=(first,)) for first in range(3)]
    for thread in threads:
        thread.start()
    try:
        yield wrong
    finally:
        for thread in threads:
            thread.join(120)
    assert wrong == []


def reach(store: Store, keyframes: int, wrong: list[BaseException]) -> None:
    """Waits for so many, in the middle of the work."""
    services.wait_until(lambda: bool(wrong) or stored(store) >= keyframes, f"{keyframes} keyframes")
    assert stored(store) < FRAMES, "the ingest was over before anything was done to the cluster"


def check_equal(cluster: clusters.Cluster) -> None:
    """All tables have equal checksums on all nodes."""
    where = "table_schema = 'semdb' AND table_type = 'BASE TABLE'"
    query = f"SELECT table_name FROM information_schema.tables WHERE {where} ORDER BY table_name"
    names = ", ".join(f"semdb.{name}" for (name,) in cluster.nodes[0].execute(query))
    sums = [node.execute(cluster.sync, f"CHECKSUM TABLE {names}") for node in cluster.nodes]
    assert len(sums[0]) >= 15
    assert all(value is not None for _, value in sums[0])
    assert sums[0] == sums[1] == sums[2]


@pytest.mark.long
def test_a_group_of_mysql_changes_its_primary_and_loses_it(group: clusters.Group, tmp_path: Path) -> None:
    room = small_room(tmp_path)
    first, second, third = group.nodes
    first.execute(
        f"CREATE USER writer@'127.0.0.1' IDENTIFIED BY '{group.password}'",
        "GRANT SELECT, INSERT, UPDATE, DELETE ON semdb.* TO writer@'127.0.0.1'",
        f"GRANT SELECT ON {MEMBERS_TABLE} TO writer@'127.0.0.1'",  # as docs/scaling.md has it
    )
    with open_store(group.url(0)) as store, ingested(room, tmp_path) as undisturbed:
        with watched(group, 0) as watch, ingesting(group, room) as wrong:
            reach(store, 10, wrong)
            group.elect(second)  # the first goes on, and takes no writes any more
            reach(store, 40, wrong)
            second.kill()
        assert max(watch.gaps) < LONGEST_GAP_S
        assert content(store) == content(undisturbed)
        assert group.primary(third) in (first, third)
    second.start()  # outside of the group, and it takes writes: they would be lost
    assert second.execute("SELECT @@read_only") == [(0,)]
    with open_store(group.url(1).replace("semdb_test:", "writer:")) as store:
        assert retry.read(store.engine, lambda c: c.execute(text("SELECT @@port")).scalar()) != second.port
        assert server_facts(store.engine).cluster_size == 2
        store.ensure_map("another")
    group.join(second)
    check_equal(group)
    reading_goes_on_without_a_primary(group)


def reading_goes_on_without_a_primary(group: clusters.Group) -> None:
    """Of nodes that take no writes one is read, and what it cannot do is said."""
    replicas = [node for node in group.nodes if node is not group.primary(group.nodes[0])]
    one, other = replicas
    with open_store(one.url().replace(f":{one.port}/", f":{one.port},127.0.0.1:{other.port}/")) as store:
        assert {info.name for info in store.maps()} == {"m", "another"}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(retry, "RESTART_S", 0.0)
            patch.setattr(retry, "ATTEMPTS", 3)
            with pytest.raises(DatabaseError, match="takes no writes"):
                store.ensure_map("a third")


@pytest.mark.long
@pytest.mark.parametrize("group", [()], ids=["with MySQL's own limits"], indirect=True)
def test_workers_outlive_three_primaries(group: clusters.Group, tmp_path: Path) -> None:
    """Two workers of two processes; each primary in turn is killed with SIGKILL, and comes back."""
    frames = 400
    room = render(tmp_path / "room", SyntheticOptions(frames=frames, width=96, height=72, lap_frames=200))
    expected = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    ingest_recordings([room], settings(expected), OPTIONS)
    url = group.url(0)
    with services.redis(tmp_path) as broker, open_store(url) as store, watched(group, 0) as watch:
        where = {"SEMDB_BROKER_URL": broker.url, **SPECS}
        queued = semdb("ingest", room, "--queue", "--stride", 1, "--map", "m", url=url, **where)
        assert queued.returncode == 0, queued.stderr
        started = [services.start_worker(tmp_path, group.url(k), broker.url, processes=2, **SPECS) for k in range(2)]
        with services.workers(*started):
            for keyframes in (40, 150, 260):
                services.wait_until(lambda least=keyframes: stored(store) >= least, f"{keyframes} keyframes", 180)
                primary = group.primary(group.nodes[0])
                assert primary is not None
                primary.kill()
                others = [node for node in group.nodes if node is not primary]
                services.wait_until(
                    lambda gone=primary, seen_by=others[0]: group.primary(seen_by) not in (None, gone), "an election"
                )
                group.rejoin(primary)
            services.wait_until(lambda: is_complete(store), "the recording is complete", 180)
        assert max(watch.gaps) < LONGEST_GAP_S
        assert rows_per_table(store)["keyframes"] == frames
        assert store.failed_items() == []
        with open_store(expected) as undisturbed:
            assert content(store) == content(undisturbed)
    check_equal(group)
