"""The Celery application: its settings, its one task, and what is said without the extra."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from semdb.database.store import open_store
from semdb.errors import UsageError
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.settings import Settings
from semdb.workers import INGEST_TASK, app, make_app
from semdb.workers.tasks import ingest_recording


def test_messages_are_given_back_and_taken_one_by_one() -> None:
    made = make_app(Settings(broker_url="redis://elsewhere:6380/3"))
    assert made.conf.broker_url == "redis://elsewhere:6380/3"
    assert made.conf.task_acks_late is True
    assert made.conf.task_reject_on_worker_lost is True
    assert made.conf.worker_prefetch_multiplier == 1
    assert made.conf.accept_content == ["json"]


def test_the_task_is_registered_by_its_name() -> None:
    assert INGEST_TASK == "semdb.ingest_recording"
    assert app.tasks[INGEST_TASK].name == INGEST_TASK


def test_the_task_ingests_and_adds_nothing_when_it_comes_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_synthetic_recording(tmp_path / "room", SyntheticOptions(frames=4, width=160, height=120))
    url = f"sqlite:///{tmp_path / 'semdb.sqlite3'}"
    monkeypatch.setenv("SEMDB_DATABASE_URL", url)
    monkeypatch.setenv("SEMDB_FEATURES", "orb")
    message = json.loads(json.dumps({"map_name": "flat", "name": "visit", "options": {"keyframes": 2}}))

    first = ingest_recording.apply(args=[str(tmp_path / "room")], kwargs=message, throw=True).get()
    assert first == [{"map": "flat", "recording": "visit", "planned": 2, "already_stored": 0, "stored": 2, "failed": 0}]
    second = ingest_recording.apply(args=[str(tmp_path / "room")], kwargs=message, throw=True).get()
    assert second[0]["already_stored"] == 2
    assert second[0]["stored"] == 0
    with open_store(url) as store:
        (status,) = store.status()
    assert (status.map, status.name, status.keyframes, str(status.state)) == ("flat", "visit", 2, "complete")


def test_the_task_refuses_options_that_it_does_not_know() -> None:
    with pytest.raises(UsageError, match="no option 'speed'"):
        ingest_recording.apply(args=["nowhere"], kwargs={"options": {"speed": 3}}, throw=True)


def test_without_the_extra_the_import_says_what_to_install() -> None:
    code = "import sys; sys.modules['celery'] = None; import semdb.workers"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].endswith("semdb.workers needs the worker extra: pip install 'semdb[worker]'")
