"""A cluster of three Galera nodes on loopback: ingest through all of them, one killed, one back and equal."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest
from sqlalchemy import text

from semdb.database import retry, schema
from semdb.database.engine import make_engine
from semdb.database.store import open_store
from semdb.errors import DatabaseError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings
from tests import clusters, services
from tests.integration.comparison import content, rows_per_table
from tests.rooms import render

LONGEST_GAP_S = 15.0
FRAMES = 90


def settings(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", features="orb", threads=1)


@pytest.fixture(scope="module")
def cluster() -> Iterator[clusters.Cluster]:
    with clusters.cluster() as made:
        engine = make_engine(made.url())
        schema.upgrade(engine)
        engine.dispose()
        yield made


def test_concurrent_ingest_a_killed_node_and_its_return(
    cluster: clusters.Cluster, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("cluster")
    room = render(folder / "room", SyntheticOptions(frames=FRAMES, width=96, height=72, lap_frames=90))
    options = IngestOptions(stride=1, map_name="m")
    undisturbed = f"sqlite:///{folder / 'a.sqlite3'}"
    ingest_recordings([room], settings(undisturbed), options)

    wrong: list[BaseException] = []

    def ingest(first: int) -> None:
        try:
            ingest_recordings([room], settings(cluster.url(first)), options)
        except BaseException as error:
            wrong.append(error)

    gaps: list[float] = []
    ended = threading.Event()
    cluster.nodes[0].execute("CREATE TABLE semdb.beats (number INT PRIMARY KEY)")
    beat = text("INSERT IGNORE INTO beats VALUES (:number)")

    def watch() -> None:
        """The longest times in which nobody can write, nor read what was written, where the killed node is first."""
        last, number = time.monotonic(), 0
        with open_store(cluster.url(1)) as store:
            while not ended.is_set():
                number += 1
                row = {"number": number}
                try:
                    retry.write(store.engine, lambda c, row=row: c.execute(beat, row))
                    newest = retry.read(
                        store.engine, lambda c: c.execute(text("SELECT MAX(number) FROM beats")).scalar()
                    )
                except DatabaseError:
                    continue
                if newest != number:
                    wrong.append(AssertionError(f"wrote {number}, read {newest}"))
                gaps.append(time.monotonic() - last)
                last = time.monotonic()
                time.sleep(0.02)
        gaps.append(time.monotonic() - last)  # that it cannot to this day is a gap, too

    threads = [threading.Thread(target=ingest, args=(first,)) for first in range(3)]
    watcher = threading.Thread(target=watch)
    with open_store(cluster.url(0)) as store:
        for thread in (*threads, watcher):
            thread.start()
        services.wait_until(lambda: bool(wrong) or rows_per_table(store)["keyframes"] >= 15, "15 keyframes")
        cluster.nodes[1].kill()
        assert rows_per_table(store)["keyframes"] < FRAMES, "the ingest was over before the node was killed"
        for thread in threads:
            thread.join(120)
        ended.set()
        watcher.join(60)
        assert wrong == []
        assert len(gaps) > 20
        assert max(gaps) < LONGEST_GAP_S
        with open_store(undisturbed) as expected:
            assert content(store) == content(expected)
    cluster.rejoin(cluster.nodes[1])
    names = tables(cluster)
    sums = [node.execute("SET SESSION wsrep_sync_wait = 1", f"CHECKSUM TABLE {names}") for node in cluster.nodes]
    assert len(sums[0]) >= 15
    assert all(value is not None for _, value in sums[0])
    assert sums[0] == sums[1] == sums[2]
    one_node_that_is_alive_is_enough(cluster)


def tables(cluster: clusters.Cluster) -> str:
    where = "table_schema = 'semdb' AND table_type = 'BASE TABLE'"
    query = f"SELECT table_name FROM information_schema.tables WHERE {where} ORDER BY table_name"
    return ", ".join(f"semdb.{name}" for (name,) in cluster.nodes[0].execute(query))


def one_node_that_is_alive_is_enough(cluster: clusters.Cluster) -> None:
    port = services.free_port()
    alive = cluster.nodes[2]
    url = alive.url().replace("@", f"@127.0.0.1:{port},")
    with open_store(url) as store:
        assert isinstance(store.maps(), list)
        assert store.url == f"mysql+pymysql://semdb_test:***@127.0.0.1:{port},127.0.0.1:{alive.port}/semdb"
