"""Service, worker and database are killed in turn while clients ask: they hear of it, or wait, and nothing is lost."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

import semdb
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import open_store
from semdb.errors import DatabaseUnavailableError, SemdbError
from semdb.recordings import open_recording
from semdb.types import Frame
from tests import servers, services
from tests.integration.comparison import content, is_complete, rows_per_table
from tests.integration.opened import MODELS, STRIDE
from tests.integration.test_service_process import process
from tests.rooms import semdb as run_semdb
from tests.services import free_port, start_worker, wait_until, workers

CLIENTS = 4
OF_WORKERS = {f"SEMDB_{name.upper()}": value for name, value in MODELS.items()}


class Askers:
    """Clients of `semdb.connect` that localize frames all the time; a context manager."""

    def __init__(self, address: str, frames: list[Frame], patience_s: float) -> None:
        self._address, self._frames, self._patience_s = address, frames, patience_s
        self.answers: list[str] = []  # names of images that were answered
        self.poses: set[bytes] = set()
        self.errors: list[SemdbError] = []
        self._over = threading.Event()
        self._threads = [threading.Thread(target=self._ask, args=(number,)) for number in range(CLIENTS)]

    def _ask(self, client: int) -> None:
        number = 0
        with semdb.connect(self._address, patience_s=self._patience_s, retries=100, say=lambda _: None) as db:
            while not self._over.is_set():
                name, number = f"{client}-{number}", number + 1
                try:
                    found = db.localize(self._frames[0], map="office", name=name)
                    assert found.world_from_camera is not None
                    self.answers.append(name)
                    self.poses.add(found.world_from_camera.tobytes())
                except SemdbError as error:
                    self.errors.append(error)

    def more(self, count: int = 6) -> None:
        """Waits until so many more are answered."""
        wanted = len(self.answers) + count
        wait_until(lambda: len(self.answers) >= wanted, "clients are answered", 120)

    def __enter__(self) -> Askers:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()


@pytest.fixture(scope="module")
def shown(room: Path) -> list[Frame]:
    return list(open_recording(room).frames())[6:7]


@contextlib.contextmanager
def service(url: str, folder: Path, port: int, **settings: str) -> Iterator[Any]:
    """`semdb serve` on a port of its own, so that it can be there again."""
    given = {"SEMDB_CACHE_DIR": str(folder / "cache"), "SEMDB_SERVE_RATE": "0", **settings}
    log = folder / f"log-{time.monotonic_ns()}"
    with process(url, log, "--port", str(port), **given) as (found, _):
        yield found
    assert "Traceback" not in log.read_text(), log.read_text()[-3000:]


@pytest.mark.long
def test_the_service_is_killed_while_it_is_asked(room: Path, shown: list[Frame], tmp_path: Path) -> None:
    url, port = f"sqlite:///{tmp_path / 'a.sqlite3'}", free_port()
    with semdb.open(url, threads=1, cache_dir=tmp_path / "cache", **MODELS) as database:
        database.ingest(room, map="office", stride=STRIDE)
        before = rows_per_table(database._store())
    with Askers(f"http://127.0.0.1:{port}", shown, 60.0) as asking:
        for _ in range(3):
            with service(url, tmp_path, port) as found:
                asking.more()
                os.kill(found.pid, signal.SIGKILL)
                found.wait()
        with service(url, tmp_path, port):
            asking.more()
            asking.__exit__()
    assert asking.errors == []  # clients waited for the next one
    assert len(asking.poses) == 1
    with semdb.open(url, **MODELS) as database:
        logged = {one.image for one in database.queries("office", limit=1000)}
        assert set(asking.answers) <= logged  # what was answered is in the log
        after = rows_per_table(database._store())
    assert {name: count for name, count in after.items() if count != before[name]}.keys() == {"queries"}


@pytest.mark.long
def test_worker_and_database_are_killed_while_recordings_come_and_clients_ask(
    server_kind: servers.Kind, room: Path, shown: list[Frame], tmp_path: Path
) -> None:
    given = {"SEMDB_SERVE_INGEST_ROOTS": str(room.parent), **OF_WORKERS}
    with servers.server(server_kind, password="of-the-service") as server, services.redis(tmp_path) as broker:
        url, port = server.url(), free_port()
        schema.upgrade(make_engine(url))
        with semdb.open(url, threads=1, cache_dir=tmp_path / "cache", **MODELS) as database:
            database.ingest(room, map="office", stride=STRIDE)
        with (
            service(url, tmp_path, port, SEMDB_BROKER_URL=broker.url, **given),
            workers(start_worker(tmp_path, url, broker.url, **OF_WORKERS)) as running,
            Askers(f"http://127.0.0.1:{port}", shown, 0.0) as asking,
            httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client,
        ):
            asking.more(2)
            body = {"path": "room", "name": "again", "stride": 1, "check": False}
            job = client.post("/v1/maps/second/ingest", json=body).json()["address"]

            def stored() -> int:
                with contextlib.suppress(httpx.TransportError, KeyError, TypeError):
                    items = client.get(job).json()["items"] or {}
                    return int(items.get("done", 0))
                return 0

            wait_until(lambda: stored() >= 3, "keyframes are stored", 240)
            running[0].kill()
            running.append(start_worker(tmp_path, url, broker.url, **OF_WORKERS))
            asking.more(2)
            asking.errors.clear()
            server.kill()
            wait_until(lambda: len(asking.errors) > 2, "clients hear of it", 60)
            told = Counter(type(error) for error in asking.errors)
            assert set(told) == {DatabaseUnavailableError}, asking.errors
            assert not any("mysql" in str(error) or "of-the-service" in str(error) for error in asking.errors)
            assert client.get("/health").status_code == 200
            ready = client.get("/ready")
            assert (ready.status_code, ready.headers["content-type"]) == (503, "application/json")
            server.start()
            asking.more(2)
            # the broker gives the message of a killed worker to another after 15 minutes: not to wait for that
            resumed = run_semdb("ingest", "--resume", url=url, SEMDB_BROKER_URL=broker.url)
            assert resumed.returncode == 0, resumed.stderr
            wait_until(lambda: client.get(job).json()["state"] in ("done", "failed"), "the job ends", 300)
            found = client.get(job).json()
            assert (found["state"], found["error"]) == ("done", None), found
        assert len(asking.poses) == 1
        wanted = f"sqlite:///{tmp_path / 'wanted.sqlite3'}"
        with semdb.open(wanted, threads=1, cache_dir=tmp_path / "cache", **MODELS) as database:
            database.ingest(room, map="second", name="again", stride=1, check=False)
        with open_store(url) as store, open_store(wanted) as undisturbed:
            assert is_complete(store)
            store.delete_map(store.find_map("office").id)
            assert content(store)["frames"] == content(undisturbed)["frames"]  # nothing lost, nothing by halves
