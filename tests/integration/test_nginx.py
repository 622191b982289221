"""deploy/nginx.conf with Debian's nginx: TLS, and two services on one database."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect as websocket

import semdb
from semdb.errors import DatabaseError, DatabaseUnavailableError, SemdbError
from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.conftest import REPOSITORY
from tests.integration.opened import MODELS, STRIDE, opener
from tests.rooms import environment
from tests.services import free_port, wait_until
from tests.serving import running

SECRET = 32 * "s"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A certificate of localhost that signs itself, and its key."""
    folder = tmp_path_factory.mktemp("tls")
    files = folder / "certificate.pem", folder / "key.pem"
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost", "-days", "2"]
    output = ["-out", str(files[0]), "-keyout", str(files[1])]
    subprocess.run([*command, *names, *output], check=True, capture_output=True, timeout=60)
    return files


@contextlib.contextmanager
def proxied(folder: Path, ports: Sequence[int], certificate: tuple[Path, Path]) -> Iterator[str]:
    """The address of nginx with the file of the repository, its ports, name and certificate exchanged."""
    program = shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
    if program is None:
        pytest.skip("no nginx here: scripts/install-services.sh installs Debian's")
    port = free_port()
    text = (REPOSITORY / "deploy" / "nginx.conf").read_text()
    for old, new in {
        "listen 443": f"listen 127.0.0.1:{port}",
        "127.0.0.1:8765": f"127.0.0.1:{ports[0]}",
        "127.0.0.1:8766": f"127.0.0.1:{ports[1]}",
        "robots.example": "localhost",
        "/etc/ssl/semdb/certificate.pem": str(certificate[0]),
        "/etc/ssl/semdb/key.pem": str(certificate[1]),
    }.items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    kinds = ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    temporary = "\n".join(f"{kind}_temp_path {folder / kind};" for kind in kinds)
    user = "user root;\n" if os.geteuid() == 0 else ""  # its own account may not into folders of tests
    main = f"{user}daemon off; pid {folder / 'pid'}; error_log {folder / 'errors'}; events {{}}\n"
    (folder / "main.conf").write_text(f"{main}http {{ access_log off;\n{temporary}\n{text}\n}}\n")
    command = [program, "-p", str(folder), "-e", str(folder / "errors"), "-c", str(folder / "main.conf")]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    try:
        wait_until(lambda: (folder / "pid").exists() or process.poll() is not None, "nginx runs")
        assert process.poll() is None, process.stderr.read() if process.stderr else ""
        yield f"https://localhost:{port}"
    finally:
        process.terminate()
        process.wait(20)


def test_two_services_behind_tls(
    room: Path,
    frames: list[Frame],
    tmp_path: Path,
    certificate: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    with contextlib.ExitStack() as stack:
        opening = stack.enter_context(opener(f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "cache"))
        opening().ingest(room, map="a/b", stride=12)
        settings = ServeSettings(hosts="localhost", secret=SECRET)
        one, other = (stack.enter_context(running(opening(), settings)) for _ in range(2))
        ports = [int(served.url.rpartition(":")[2]) for served in (one, other)]
        address = stack.enter_context(proxied(tmp_path, ports, certificate))
        token = one.database.create_token("admin").secret
        with pytest.raises(DatabaseError, match="SEMDB_TOKEN"):
            semdb.connect(address).maps()
        db = stack.enter_context(semdb.connect(address, token=token))
        found = [db.localize(frames[13], map="a/b", name="x") for _ in range(4)]
        wanted = one.database.localize(frames[13], map="a/b", name="x")
        assert all((answer.world_from_camera == wanted.world_from_camera).all() for answer in found)
        with pytest.raises(DatabaseError, match="answered 403"):
            db._transport.ask("GET", "/metrics")
        made = db._transport.json("POST", "/v1/maps/a%2Fb/sessions", json={})  # what one signs, the other reads
        stream = address.replace("https", "wss") + made["stream"]
        with websocket(stream, additional_headers={"Authorization": f"Bearer {token}"}) as connection:
            connection.send(b"no image")
            assert "image" in str(connection.recv(20))
        for keyframe in db.keyframes("a/b"):  # a confirmation of one is good for the other
            assert db.delete(keyframes=[keyframe.id]).keyframes == 1


def serving(folder: Path, port: int) -> subprocess.Popen[bytes]:
    """A service as a process."""
    given = environment(
        f"sqlite:///{folder / 'a.sqlite3'}",
        SEMDB_CACHE_DIR=str(folder / "cache"),
        SEMDB_SERVE_HOSTS="localhost",
        SEMDB_SERVE_SECRET=SECRET,
        **{f"SEMDB_{name.upper()}": value for name, value in MODELS.items()},
    )
    command = [sys.executable, "-m", "semdb.cli.main", "serve", "--port", str(port)]
    return subprocess.Popen(command, env=given, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def wait_for(port: int, token: str) -> None:
    """Until a service answers."""
    with semdb.connect(f"http://127.0.0.1:{port}", token=token, patience_s=120, retries=200) as db:
        db.check()


@pytest.mark.long
def test_services_are_killed_under_load(
    room: Path,
    frames: list[Frame],
    tmp_path: Path,
    certificate: tuple[Path, Path],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As processes: one that dies is not noticed; without any there is a clear error; then all goes on."""
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    with opener(f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "cache") as opening:
        opening().ingest(room, map="office", stride=STRIDE)
        token = opening().create_token("localize").secret
    ports = [free_port(), free_port()]
    processes = [serving(tmp_path, port) for port in ports]
    answered, errors, over = list[Any](), list[SemdbError](), threading.Event()

    def load(address: str) -> None:
        with semdb.connect(address, token=token, patience_s=30) as db:
            while not over.is_set():
                try:
                    answered.append(db.localize(frames[6], map="office", name="x").verdict)
                except SemdbError as error:
                    errors.append(error)

    def goes_on() -> None:
        before = len(answered)
        wait_until(lambda: len(answered) > before + 8, "answers come", 120)

    try:
        with proxied(tmp_path, ports, certificate) as address:
            for port in ports:
                wait_for(port, token)
            threads = [threading.Thread(target=load, args=(address,)) for _ in range(3)]
            for thread in threads:
                thread.start()
            goes_on()
            processes[0].kill()
            goes_on()
            assert errors == []
            processes[0] = serving(tmp_path, ports[0])
            wait_for(ports[0], token)
            goes_on()
            processes[1].terminate()
            goes_on()
            assert errors == []
            assert set(answered) == {"localized"}
            over.set()
            for thread in threads:
                thread.join(60)
            for process in processes:
                process.kill()
                process.wait(60)
            started = time.monotonic()
            with semdb.connect(address, token=token, patience_s=3) as db:
                with pytest.raises(DatabaseUnavailableError, match=re.escape("answered 502")):
                    db.localize(frames[6], map="office")
                assert time.monotonic() - started < 30
                processes[0] = serving(tmp_path, ports[0])
                db._transport.patience_s, db._transport.retries = 120, 200
                assert db.localize(frames[6], map="office").localized
    finally:
        over.set()
        for process in processes:
            process.kill()
            process.wait(60)
