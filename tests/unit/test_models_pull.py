"""Downloads of model files, from a server on this machine that misbehaves when told to."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
import socket
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.cli.models import model_files
from semdb.errors import ModelError
from semdb.perception import catalogue
from semdb.perception.catalogue import Published
from semdb.perception.pull import RECORD, most_bytes, pull, recorded_hashes
from semdb.settings import Settings
from tests.unit.onnx_files import write_constant_model

CONTENT = bytes(np.random.default_rng(0).integers(0, 256, 3_000_000, dtype=np.uint8))
SHA256 = hashlib.sha256(CONTENT).hexdigest()


class Server(ThreadingHTTPServer):
    """`content` is served; `break_after` bytes of an answer the connection breaks; `asked` are the ranges wanted."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.content, self.break_after, self.ranges = CONTENT, 0, True
        self.redirect, self.says_length = "", True
        self.asked: list[str] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/weights.pth"


class _Handler(BaseHTTPRequestHandler):
    server: Server

    def do_GET(self) -> None:
        server = self.server
        wanted = self.headers.get("Range", "")
        server.asked.append(wanted)
        if not self.path.endswith("weights.pth"):
            self.send_error(404)
            return
        if server.redirect:
            self.send_response(302)
            self.send_header("Location", server.redirect)
            self.end_headers()
            return
        start = int(re.sub(r"\D", "", wanted)) if wanted and server.ranges else 0
        if start >= len(server.content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(server.content)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        body = server.content[start:]
        self.send_response(206 if start else 200)
        if server.says_length:
            self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        if server.break_after:
            self.wfile.write(body[: server.break_after])
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
        else:
            self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[Server]:
    with Server() as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield running
        running.shutdown()
        thread.join()


def published(url: str, sha256: str = SHA256[:8]) -> Published:
    return Published("tiny", "detector", "torchvision:tiny", "weights.pth", url, sha256, 3, "BSD", "a test")


def test_a_file_is_fetched_once_with_progress(server: Server, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    done = pull(published(server.url), tmp_path / "models", lambda have, total: seen.append((have, total)))
    assert done.path.read_bytes() == CONTENT
    assert (done.sha256, done.fetched, done.recorded) == (SHA256, True, False)
    assert seen[0] == (0, len(CONTENT))
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert len(seen) > 5
    assert [path.name for path in (tmp_path / "models").iterdir()] == ["weights.pth"]
    again = pull(published(server.url), tmp_path / "models")
    assert not again.fetched
    assert server.asked == [""]


def test_a_broken_download_goes_on_where_it_stopped(server: Server, tmp_path: Path) -> None:
    server.break_after = 1_000_000
    with pytest.raises(ModelError, match=r"broke off .*run the command again: it goes on from there"):
        pull(published(server.url), tmp_path)
    assert (tmp_path / "weights.pth.part").stat().st_size == 1_000_000
    assert not (tmp_path / "weights.pth").exists()
    server.break_after = 0
    seen: list[tuple[int, int]] = []
    done = pull(published(server.url), tmp_path, lambda have, total: seen.append((have, total)))
    assert done.path.read_bytes() == CONTENT
    assert seen[0] == (1_000_000, len(CONTENT))
    assert server.asked == ["", "bytes=1000000-"]


def test_a_server_that_cannot_resume_starts_anew(server: Server, tmp_path: Path) -> None:
    (tmp_path / "weights.pth.part").write_bytes(b"x" * 500)
    server.ranges = False
    assert pull(published(server.url), tmp_path).path.read_bytes() == CONTENT


def test_a_part_that_is_complete_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    (tmp_path / "weights.pth.part").write_bytes(CONTENT)
    assert pull(published(server.url), tmp_path).path.read_bytes() == CONTENT


def test_a_part_that_is_too_long_is_thrown_away(server: Server, tmp_path: Path) -> None:
    (tmp_path / "weights.pth.part").write_bytes(CONTENT + b"more")
    assert pull(published(server.url), tmp_path).path.read_bytes() == CONTENT


def test_a_wrong_hash_keeps_nothing(server: Server, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"SHA-256 .* but its publisher's is 01234567.*not kept"):
        pull(published(server.url, "01234567"), tmp_path)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "weights.pth").write_bytes(b"another")
    with pytest.raises(ModelError, match=r"weights\.pth is a file with the SHA-256 .*delete it and pull it again"):
        pull(published(server.url), tmp_path)


def test_the_first_hash_is_recorded_where_none_is_published(server: Server, tmp_path: Path) -> None:
    model = published(server.url, "")
    assert pull(model, tmp_path).recorded
    assert recorded_hashes(tmp_path) == {"weights.pth": SHA256}
    assert not pull(model, tmp_path).recorded
    (tmp_path / "weights.pth").unlink()
    server.content = CONTENT[::-1]
    with pytest.raises(ModelError, match=rf"but the one recorded in .*{RECORD} is {SHA256[:16]}"):
        pull(model, tmp_path)
    assert not (tmp_path / "weights.pth").exists()


def test_a_damaged_record_is_named(tmp_path: Path) -> None:
    (tmp_path / RECORD).write_text("[")
    with pytest.raises(ModelError, match=r"sha256\.json cannot be read .*delete it"):
        recorded_hashes(tmp_path)


def test_a_full_disk_is_said(server: Server, tmp_path: Path) -> None:
    (tmp_path / "weights.pth.part").symlink_to("/dev/full")
    with pytest.raises(ModelError, match=r"no room on the disk .*SEMDB_CACHE_DIR"):
        pull(published(server.url), tmp_path)


@pytest.mark.parametrize("host", ["127.0.0.1:9", "no-such-host.invalid"])
def test_without_network_the_error_says_what_to_put_where(host: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError) as caught:
        pull(published(f"http://{host}/weights.pth"), tmp_path)
    assert f"http://{host}/weights.pth cannot be reached" in str(caught.value)
    assert str(tmp_path / "weights.pth") in str(caught.value)


def test_a_file_that_moved_is_said(server: Server, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"gone answers 404 .* by hand"):
        pull(published(server.url.replace("weights.pth", "gone")), tmp_path)


def test_command_pulls_and_lists(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny = published(server.url)
    monkeypatch.setattr(catalogue, "PUBLISHED", (tiny,))
    monkeypatch.setattr(catalogue, "BY_NAME", {"tiny": tiny})
    monkeypatch.setenv("SEMDB_CACHE_DIR", str(tmp_path))
    run = CliRunner().invoke
    done = run(app, ["models", "pull", "all"])
    assert done.exit_code == 0, done.output
    assert f"tiny: pulled, {tmp_path}/models/weights.pth, sha256 {SHA256[:16]}" in done.stdout
    assert run(app, ["models", "pull", "huge"]).exit_code == 2
    outputs: dict[str, Any] = {"embedding": np.ones((1, 4), np.float32)}
    write_constant_model(tmp_path / "models" / "mine.onnx", outputs, {"licence": "MIT"})
    arguments = ["models", "list", "--json", "--database-url", f"sqlite:///{tmp_path}/none.sqlite3"]
    files = {f["file"]: f for f in json.loads(run(app, arguments).stdout)["files"]}
    assert files["weights.pth"]["sha256"] == SHA256
    assert files["weights.pth"]["licence"] == "BSD"
    assert (files["mine.onnx"]["licence"], files["mine.onnx"]["spec"]) == ("MIT", "onnx:mine.onnx")
    used = [{"map": "kitchen", "sha256": SHA256}, {"map": "office", "sha256": SHA256}, {"map": "hall", "sha256": ""}]
    at_hand = {f["file"]: f["maps"] for f in model_files(Settings(), used)}
    assert at_hand == {"weights.pth": ["kitchen", "office"], "mine.onnx": []}
    (tmp_path / "models" / "weights.pth").unlink()
    assert model_files(Settings(), used)[0]["maps"] == []
    shown = run(app, ["models", "list", "--database-url", f"sqlite:///{tmp_path}/none.sqlite3"]).stdout
    assert "weights.pth" in shown


def test_published_models_are_complete() -> None:
    for model in catalogue.PUBLISHED:
        assert all(getattr(model, field.name) for field in dataclasses.fields(model) if field.name != "sha256")
    assert [model.name for model in catalogue.PUBLISHED if not model.sha256] == ["resnet50-places365"]


def test_plain_http_is_refused_without_a_hash(tmp_path: Path) -> None:
    model = published("http://models.example.org/weights.pth", "")
    with pytest.raises(ModelError, match=r"is not encrypted, and no hash of weights\.pth is published.*--sha256 HEX"):
        pull(model, tmp_path / "models")
    assert not (tmp_path / "models").exists()
    with pytest.raises(ModelError, match="which is not fetched: only https and http are"):
        pull(published("file:///etc/passwd", ""), tmp_path / "models")


@pytest.mark.parametrize("target", ["http://models.example.org/weights.pth", "ftp://models.example.org/weights.pth"])
def test_a_redirection_to_plain_http_is_refused_without_a_hash(server: Server, tmp_path: Path, target: str) -> None:
    server.redirect = target
    with pytest.raises(ModelError, match=r"is not encrypted|is not fetched"):
        pull(published(server.url, ""), tmp_path)
    assert not (tmp_path / "weights.pth").exists()


def test_a_page_is_no_file_of_weights(server: Server, tmp_path: Path) -> None:
    server.content = b"\n<!DOCTYPE html><title>Log in</title>"
    with pytest.raises(ModelError, match="sent a page, not a file of weights; nothing was kept"):
        pull(published(server.url, ""), tmp_path)
    assert list(tmp_path.iterdir()) == []
    assert recorded_hashes(tmp_path) == {}


@pytest.mark.parametrize("says", [True, False])
def test_a_file_that_is_much_too_large_is_left(server: Server, tmp_path: Path, says: bool) -> None:
    model = published(server.url)
    server.content, server.says_length = bytes(most_bytes(model) + 1), says
    with pytest.raises(ModelError, match=r"sends 23 MB or more, but weights\.pth has 3 MB: that is another file"):
        pull(model, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_part_that_is_larger_than_the_file_can_be_is_thrown_away(server: Server, tmp_path: Path) -> None:
    with (tmp_path / "weights.pth.part").open("wb") as file:
        file.truncate(60 << 30)
    assert pull(published(server.url), tmp_path).path.read_bytes() == CONTENT
    assert server.asked == [""]


def test_command_takes_a_hash_and_goes_on_after_a_failure(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tiny = published(server.url, "")
    bad = dataclasses.replace(tiny, name="bad", file="bad.pth", url="http://models.example.org/bad.pth")
    monkeypatch.setattr(catalogue, "PUBLISHED", (bad, tiny))
    monkeypatch.setattr(catalogue, "BY_NAME", {"tiny": tiny, "bad": bad})
    monkeypatch.setenv("SEMDB_CACHE_DIR", str(tmp_path))
    run = CliRunner().invoke
    assert run(app, ["models", "pull", "tiny", "--sha256", "12"]).exit_code == 2
    wrong = run(app, ["models", "pull", "tiny", "--sha256", "0" * 64])
    assert (wrong.exit_code, "not kept" in wrong.stderr) == (1, True)
    done = run(app, ["models", "pull", "all"])
    assert done.exit_code == 1
    assert "bad.pth is not encrypted" in done.stderr
    assert "tiny: pulled" in done.stdout
    right = run(app, ["models", "pull", "tiny", "--sha256", SHA256.upper()])
    assert "as it should be" in right.stdout
