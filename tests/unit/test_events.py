"""Events as lines of JSON, and passwords of the command line."""

from __future__ import annotations

import io
import json
import logging
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from semdb.events import LOGGER, event, log_to
from semdb.recordings import png
from semdb.recordings.synthetic import SyntheticOptions
from tests.rooms import render, semdb


@pytest.fixture
def restored() -> Iterator[None]:
    before = (LOGGER.handlers, LOGGER.level, LOGGER.propagate)
    yield
    LOGGER.handlers, LOGGER.propagate = before[0], before[2]
    LOGGER.setLevel(before[1])


@pytest.mark.usefixtures("restored")
def test_an_event_is_one_line_of_json() -> None:
    stream = io.StringIO()
    log_to(stream)
    event("stored", recording=3, frame=17, error=None, store=0.25)
    logging.getLogger("semdb.other").warning("two\nlines %d", 5)
    first, second = map(json.loads, stream.getvalue().splitlines())
    assert first.pop("time").endswith("Z")
    assert first == {
        "level": "info",
        "logger": "semdb",
        "event": "stored",
        "recording": 3,
        "frame": 17,
        "error": None,
        "store": 0.25,
    }
    assert (second["level"], second["message"]) == ("warning", "two\nlines 5")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the list of processes is Linux'")
def test_a_password_on_the_command_line_is_overwritten_in_the_list_of_processes() -> None:
    url = "mysql+pymysql://me:secret-word@127.0.0.1:1/schema"
    code = (
        "import sys, time; from semdb.cli.options import Overrides; "
        "assert 'secret-word' in Overrides(database_url=sys.argv[1]).settings().database_url; "
        "print('ready', flush=True); time.sleep(60)"
    )
    process = subprocess.Popen([sys.executable, "-c", code, url, "after"], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
        deadline = time.monotonic() + 10
        shown = Path(f"/proc/{process.pid}/cmdline").read_bytes().split(b"\0")
        assert time.monotonic() < deadline
        assert shown[-3:-1] == [b"mysql+pymysql://me:***********@127.0.0.1:1/schema", b"after"]
    finally:
        process.kill()
        process.wait()


def test_an_ingest_logs_each_keyframe_on_request(tmp_path: Path) -> None:
    render(tmp_path / "room", SyntheticOptions(frames=3, width=64, height=48))
    (tmp_path / "room" / "rgb" / "1.033333.png").write_bytes(
        (tmp_path / "room" / "rgb" / "1.033333.png").read_bytes()[:-30] + bytes(18) + png.END
    )
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    chosen = {"SEMDB_FEATURES": "orb", "SEMDB_LOG_FORMAT": "json"}
    done = semdb("ingest", tmp_path / "room", "--stride", 1, url=url, **chosen)
    events = [json.loads(line) for line in done.stderr.splitlines() if line.startswith("{")]
    assert [(line["event"], line["frame"]) for line in events] == [("stored", 0), ("failed", 1), ("stored", 2)]
    assert "1.033333.png" in events[1]["error"]
    assert set(events[0]) >= {"time", "level", "recording", "read", "detect", "encode", "features", "store"}
