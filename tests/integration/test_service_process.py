"""`semdb serve` as a process: several workers, JSON logs, HTTPS, an end that waits, and servers behind it."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import ssl
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from sqlalchemy.engine import make_url

import semdb
from semdb.database import accounts, schema
from semdb.database.engine import make_engine
from semdb.database.store import open_store
from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.database_samples import fill
from tests.integration.opened import opener
from tests.integration.test_tls import write_certificate
from tests.rooms import COMMAND, environment
from tests.rooms import semdb as run_semdb
from tests.servers import TestServer
from tests.serving import form_of, running


@contextlib.contextmanager
def process(url: str, log: Path, *options: str, **settings: str) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """`semdb serve` and where it listens."""
    command = [*COMMAND, "serve", "--port", "0", *options]
    with log.open("w") as stderr:
        found = subprocess.Popen(command, env=environment(url, **settings), stderr=stderr)
    try:
        for _ in range(600):
            listens = re.search(r"running on (https?://[\w.]+:\d+)", log.read_text())
            if listens is not None:
                break
            assert found.poll() is None, log.read_text()
            time.sleep(0.1)
        assert listens is not None, log.read_text()
        yield found, listens[1]
    finally:
        found.terminate()
        found.wait(60)


def wait_for(address: str) -> None:
    """Until one of several processes answers: the address is said before they are there."""
    for _ in range(600):
        with contextlib.suppress(httpx.TransportError):
            if httpx.get(f"{address}/health", timeout=30).status_code == 200:
                return
        time.sleep(0.1)
    raise AssertionError(address)


@pytest.fixture
def file_url(tmp_path: Path) -> str:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with open_store(url, create=True) as store:
        fill(store)
    return url


@pytest.mark.long
def test_two_processes_share_an_address(file_url: str, tmp_path: Path) -> None:
    log = tmp_path / "log"
    with (
        process(file_url, log, "--workers", "2", SEMDB_LOG_FORMAT="json") as (running_one, address),
        httpx.Client(base_url=address, timeout=30) as client,
    ):
        wait_for(address)
        for number in range(20):
            with httpx.Client(base_url=address, timeout=30) as other:
                answer = other.get("/v1/maps", headers={"X-Request-Id": f"mine-{number}"})
                assert (answer.status_code, answer.headers["x-request-id"]) == (200, f"mine-{number}")
        counted = re.search(
            r'semdb_requests_total\{method="GET",route="/v1/maps",status="200"\} (\d+)', client.get("/metrics").text
        )
        assert counted is not None
        assert int(counted[1]) == 20  # those of both
        deleted = client.delete("/v1/keyframes/1").json()["confirmation"]
        for _ in range(8):  # whichever process made it
            with httpx.Client(base_url=address, timeout=30) as other:
                assert other.delete("/v1/keyframes/2", params={"confirm": deleted}).json()["status"] == 409
                assert "not of" not in other.delete("/v1/keyframes/1").json()["detail"]
        with httpx.Client(base_url=address, timeout=30) as other:
            assert other.delete("/v1/keyframes/1", params={"confirm": deleted}).status_code == 200
        running_one.send_signal(signal.SIGTERM)
        assert running_one.wait(60) == 0
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    told = [line for line in lines if line.get("event") == "request" and line["request_id"] == "mine-7"]
    assert [(line["path"], line["status"], line["who"]) for line in told] == [("/v1/maps", 200, "loopback")]
    assert "Traceback" not in log.read_text()


@pytest.mark.long
def test_cameras_are_tracked_by_two_processes(room: Path, frames: list[Frame], tmp_path: Path) -> None:
    url, cache = f"sqlite:///{tmp_path / 'a.sqlite3'}", str(tmp_path / "cache")
    sent = [form_of(frame, depth=True) for frame in frames[4:16]]
    with opener(url, Path(cache)) as opening:
        opening().ingest(room, map="office", stride=4)
        tracker = opening().tracker("office")
        wanted = [tracker.update(frame, time_s=frame.timestamp_ns / 1e9) for frame in frames[4:16]]
    with process(url, tmp_path / "log", "--workers", "2", SEMDB_CACHE_DIR=cache) as (_, address):
        wait_for(address)
        opened = httpx.post(f"{address}/v1/maps/office/sessions", json={}, timeout=120).json()
        # a connection that is kept stays with one process, whichever made the session
        with httpx.Client(base_url=address, timeout=120) as client:
            kept = [client.post(opened["frames"], data=form, files=files).json() for form, files in sent]
        assert [one["frames"] for one in kept] == list(range(1, len(sent) + 1))
        for one, frame in zip(kept, wanted, strict=True):
            assert frame.world_from_camera is not None
            assert (one["state"], one["world_from_camera"]) == (str(frame.state), frame.world_from_camera.tolist())
        # a connection each: whichever process a frame comes to answers, and says where it begins anew
        session = httpx.post(f"{address}/v1/maps/office/sessions", json={}, timeout=120).json()["frames"]
        found = [httpx.post(f"{address}{session}", data=form, files=files, timeout=120) for form, files in sent]
        assert {answer.status_code for answer in found} == {200}
        anew = [number for number, one in enumerate(found) if "looked for anew" in str(one.json()["notes"])]
        first = [number for number, one in enumerate(found) if one.json()["frames"] == 1]
        assert len(anew) <= 1  # the other process begins once, and then goes on
        assert set(anew) <= set(first)
        for one, frame in zip(found, frames[4:16], strict=True):
            assert np.linalg.norm(np.array(one.json()["pose"]["position"]) - frame.world_from_camera[:3, 3]) < 0.05
    assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.mark.long
def test_https(file_url: str, tmp_path: Path) -> None:
    certificate, key = sorted(
        write_certificate(tmp_path, "server", "127.0.0.1"), key=lambda path: path.suffix != ".pem"
    )
    options = ("--tls-certificate", str(certificate), "--tls-key", str(key))
    with process(file_url, tmp_path / "log", *options) as (_, address):
        assert address.startswith("https://")
        trusted = ssl.create_default_context(cafile=str(certificate))
        answer = httpx.get(f"{address}/v1/maps", verify=trusted)
        assert (answer.status_code, answer.headers["strict-transport-security"]) == (200, "max-age=31536000")
    done = run_semdb("serve", "--tls-key", key, url=file_url)
    assert (done.returncode, "needs both" in done.stderr) == (2, True)


def test_what_cannot_be_served_is_said(tmp_path: Path) -> None:
    done = run_semdb("serve", url=f"sqlite:///{tmp_path / 'none.sqlite3'}")
    assert (done.returncode, "there is no database" in done.stderr) == (1, True)
    hidden = tmp_path / "fastapi.py"
    hidden.write_text("raise ModuleNotFoundError('no', name='fastapi')")
    done = run_semdb("serve", url=f"sqlite:///{tmp_path / 'none.sqlite3'}", PYTHONPATH=str(tmp_path))
    assert (done.returncode, "pip install 'semdb[serve]'" in done.stderr) == (2, True), done.stderr


@pytest.mark.long
def test_a_service_that_is_killed_leaves_its_job_to_the_next(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with semdb.open(url) as made:
        made.init()
    given = {"SEMDB_SERVE_INGEST_ROOTS": str(room.parent), "SEMDB_CACHE_DIR": str(tmp_path / "cache")}
    with process(url, tmp_path / "log", **given) as (first, address):
        asked = httpx.post(f"{address}/v1/maps/office/ingest", json={"path": "room", "keyframes": 3})
        job = asked.json()["address"]
        for _ in range(100):
            if httpx.get(f"{address}{job}").json()["state"] == "running":
                break
            time.sleep(0.05)
        with httpx.stream("GET", f"{address}{job}/events", timeout=60) as stream:  # goes on while the job runs
            assert next(stream.iter_lines()) == "event: progress"
        os.kill(first.pid, signal.SIGKILL)
        first.wait()
    with open_store(url) as store, store.engine.begin() as connection:  # not to wait for a minute
        connection.exec_driver_sql("UPDATE service_jobs SET lease_until = '2020-01-01' WHERE state = 'running'")
    with process(url, tmp_path / "log2", **given) as (_, address):
        for _ in range(1200):
            found = httpx.get(f"{address}{job}").json()
            if found["state"] in ("done", "failed"):
                break
            time.sleep(0.1)
        assert (found["state"], found["items"]) == ("done", {"done": 3}), found
        assert httpx.get(f"{address}/v1/maps/office").json()["keyframes"] == 3


def test_servers_answer_as_the_library_and_plan_for_workers(
    database_server: TestServer,
    server_url: str,
    room: Path,
    frames: list[Frame],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[int, list[int]]] = []
    monkeypatch.setattr("semdb.service.ingesting._send", lambda: lambda key, _, found: sent.append((key, list(found))))
    admin = make_url(server_url)
    plan = accounts.plan_accounts(server_url, roles=("reader",))
    schema.upgrade(make_engine(server_url))
    with opener(server_url, tmp_path / "cache") as opening:
        opening().ingest(room, map="office", stride=12)
        accounts.execute(server_url, plan.statements)
        try:
            settings = ServeSettings(ingest_roots=str(room.parent), sql_rows=3)
            with running(opening(reader_url=plan.urls["reader"], sql_time_limit_s=0.5), settings) as served:
                form, files = form_of(frames[6], depth=True)
                found = served.client.post("/v1/maps/office/localize", data=form, files=files).json()
                wanted = served.database.localize(frames[6], map="office", name="frame")
                assert found["world_from_camera"] == wanted.world_from_camera.tolist()
                assert found["covariance"] == wanted.covariance.tolist()
                rows = served.client.get("/v1/sql", params={"sql": "SELECT name FROM recordings"})
                assert rows.json()["rows"] == [["room"]], rows.text
                endless = {"sql": f"SELECT SUM(a.score) FROM {', '.join(f'objects {name}' for name in 'abcdefghij')}"}
                ended = served.client.get("/v1/sql", params=endless)
                assert (ended.status_code, "longer than 0.5 s" in ended.json()["detail"]) == (422, True), ended.text
                more = served.client.get("/v1/sql", params={"sql": "SELECT a.id FROM objects a, objects b"})
                assert (len(more.json()["rows"]), more.json()["truncated"]) == (3, True)
                token = served.database.create_token("read")
                with served.with_token(token.secret) as client:
                    for statement in ("SELECT * FROM access_tokens", "SELECT source FROM `recordings`"):
                        answer = client.get("/v1/sql", params={"sql": statement})
                        assert (answer.status_code, "is not shown here" in answer.text) == (422, True)
                    listed = client.get("/v1/sql", params={"sql": "SELECT recording, objects FROM recording_summary"})
                    assert listed.status_code == 200, listed.text
                served.database.revoke_token(token.token.id)
                assert served.client.get("/v1/maps").status_code == 200
                body = {"path": "room", "name": "again", "stride": 12}
                job = served.client.post("/v1/maps/second/ingest", json=body).json()
                for _ in range(600):
                    state = served.client.get(job["address"]).json()
                    if state["state"] not in ("waiting", "running"):
                        break
                    time.sleep(0.1)
                assert (state["state"], state["items"]) == ("working", {"pending": 2}), state
                assert [len(found) for _, found in sent] == [2]
        finally:
            name = accounts.account_name(str(admin.database), "reader")
            database_server.execute(f"DROP USER IF EXISTS '{name}'@'%'")
