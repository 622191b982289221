"""A service as a process under load, for minutes."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pymysql
import pytest
from sqlalchemy.engine import make_url

import semdb
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.recordings import open_recording
from semdb.types import Frame
from tests.integration.opened import MODELS, STRIDE
from tests.integration.test_service_process import process
from tests.servers import TestServer
from tests.serving import form_of

QUERIES, CLIENTS = 2000, 20


def memory_mib(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024
    raise AssertionError(pid)


@pytest.mark.long
def test_two_thousand_localizations_of_twenty_clients(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with semdb.open(url, threads=1, cache_dir=tmp_path / "cache", **MODELS) as database:
        database.ingest(room, map="office", stride=STRIDE)
    frames: list[Frame] = list(open_recording(room).frames())[1::5]
    forms = [form_of(frame) for frame in frames]
    given = {"SEMDB_CACHE_DIR": str(tmp_path / "cache"), "SEMDB_SERVE_RATE": "0"}
    with process(url, tmp_path / "log", **given) as (service, address):
        statuses: Counter[int] = Counter()
        taken: list[float] = []
        marks: list[float] = []

        def ask(number: int) -> None:
            form, files = forms[number % len(forms)]
            started = time.perf_counter()
            answer = httpx.post(f"{address}/v1/maps/office/localize", data=form, files=files, timeout=120)
            taken.append(time.perf_counter() - started)
            statuses[answer.status_code] += 1
            if number % 100 == 99:
                marks.append(memory_mib(service.pid))

        for number in range(10):
            ask(number)
        alone = sorted(taken[2:])[-1]
        taken.clear()
        with ThreadPoolExecutor(CLIENTS) as pool:
            list(pool.map(ask, range(QUERIES)))
        p95 = sorted(taken)[int(0.95 * len(taken))]
        print(f"alone {alone:.3f} s, p95 {p95:.3f} s, {dict(statuses)}, MiB {[round(m) for m in marks]}")
        assert set(statuses) <= {200, 429}
        assert p95 < 25 * alone
        assert marks[-1] < 1.1 * marks[len(marks) // 4]
    assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.mark.long
def test_connections_that_the_server_ends(
    database_server: TestServer, server_url: str, room: Path, tmp_path: Path
) -> None:
    schema.upgrade(make_engine(server_url))
    with semdb.open(server_url, threads=1, cache_dir=tmp_path / "cache", **MODELS) as database:
        database.ingest(room, map="office", stride=2 * STRIDE)
    form, files = form_of(list(open_recording(room).frames())[6])
    name = make_url(server_url).database
    with process(server_url, tmp_path / "log", SEMDB_CACHE_DIR=str(tmp_path / "cache")) as (_, address):
        told: list[tuple[int, str]] = []
        over = threading.Event()

        def ask() -> None:
            while not over.is_set():
                answer = httpx.post(f"{address}/v1/maps/office/localize", data=form, files=files, timeout=120)
                told.append((answer.status_code, answer.text))

        threads = [threading.Thread(target=ask) for _ in range(3)]
        for thread in threads:
            thread.start()
        for wanted in (5, 10, 15):
            while len(told) < wanted:
                time.sleep(0.1)
            listed = f"SELECT id FROM information_schema.processlist WHERE db = '{name}'"
            for (number,) in database_server.execute(listed):
                with contextlib.suppress(pymysql.MySQLError):
                    database_server.execute(f"KILL {number}")
        while len(told) < 25:
            time.sleep(0.1)
        over.set()
        for thread in threads:
            thread.join()
    assert {status for status, _ in told} <= {200, 503}
    assert {status for status, _ in told[-3:]} == {200}
    assert not any("mysql" in text for status, text in told if status != 200)
