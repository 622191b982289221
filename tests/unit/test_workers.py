"""The Celery application: its settings, its tasks, and what is said without the extra."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from celery.exceptions import Reject, Retry, SoftTimeLimitExceeded
from typer.testing import CliRunner

from semdb.cli.main import app as cli
from semdb.database.store import open_store
from semdb.errors import (
    DatabaseError,
    DatabaseUnavailableError,
    ModelError,
    ProvenanceError,
    RecordingError,
    SchemaError,
    UsageError,
)
from semdb.ingestion.queue import ChunkOutcome, Workplace
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.settings import Settings
from semdb.workers import (
    HARD_LIMIT_S,
    INGEST_TASK,
    ITEMS_TASK,
    SOFT_LIMIT_S,
    BrokerError,
    again,
    app,
    make_app,
    stopping,
    tasks,
)
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


def test_the_task_plans_and_sends_and_adds_nothing_when_it_comes_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_synthetic_recording(tmp_path / "room", SyntheticOptions(frames=4, width=160, height=120))
    url = f"sqlite:///{tmp_path / 'semdb.sqlite3'}"
    monkeypatch.setenv("SEMDB_DATABASE_URL", url)
    monkeypatch.setenv("SEMDB_FEATURES", "orb")
    sent: list[tuple[int, str, tuple[int, ...]]] = []
    monkeypatch.setattr(tasks, "send_items", lambda *message: sent.append(message))
    message = json.loads(json.dumps({"map_name": "flat", "name": "visit", "options": {"keyframes": 2}}))

    for _ in range(2):
        planned = ingest_recording.apply(args=[str(tmp_path / "room")], kwargs=message, throw=True).get()
        assert planned == [{"map": "flat", "recording": "visit", "planned": 2, "already_stored": 0}]
    [(recording_id, source, frames)] = sent  # the second one is not sent, for the first is on its way
    assert (recording_id, source, len(frames)) == (1, str(tmp_path / "room"), 2)
    assert Workplace(Settings(database_url=url, features="orb")).do(*sent[0]).stored == 2
    with open_store(url) as store:
        (status,) = store.status()
    assert (status.map, status.name, status.keyframes, str(status.state)) == ("flat", "visit", 2, "complete")


class Sent:
    """Stands for `retry` of a task: pauses with which messages were sent again."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, name: str, retries: int = 0) -> None:
        self.task = app.tasks[name]
        self.pauses: list[float] = []
        monkeypatch.setattr(self.task, "retry", self)
        monkeypatch.setattr(self.task.request, "retries", retries)

    def __call__(self, *, countdown: float, **_: Any) -> Retry:
        self.pauses.append(countdown)
        return Retry()


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Pauses that this process made."""
    made: list[float] = []
    monkeypatch.setattr(again, "_pause", made.append)
    monkeypatch.setattr(again, "_faults", [])
    return made


class Place:
    """A workplace of which `do` raises, or returns, what it is told."""

    def __init__(self, *outcomes: object) -> None:
        self.outcomes = list(outcomes)

    def do(self, *_: Any, **__: Any) -> ChunkOutcome:
        outcome = self.outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        assert isinstance(outcome, ChunkOutcome)
        return outcome


FAULTS = [
    ProvenanceError("other models"),
    ModelError("no such file"),
    SchemaError("older"),
    UsageError("another recording"),
    DatabaseError("access denied"),
    OSError("no room"),
]


def test_faults_of_the_worker_are_sent_at_once_and_it_pauses_longer_each_time(
    monkeypatch: pytest.MonkeyPatch, pauses: list[float], caplog: pytest.LogCaptureFixture
) -> None:
    place = Place(*FAULTS, ChunkOutcome(), ModelError("again"))
    sent = Sent(monkeypatch, ITEMS_TASK)
    monkeypatch.setattr(tasks, "_workplaces", [place])
    for number, fault in enumerate(FAULTS):
        with caplog.at_level(logging.ERROR, "semdb"), pytest.raises(Retry):
            sent.task(1, "room", [1, 2])
        assert len(caplog.records) == number + 1
        assert str(fault) in caplog.records[-1].getMessage()
        assert 2.0**number <= pauses[-1] <= 2.0 ** (number + 1)
    assert sent.pauses == [0.0] * len(FAULTS)
    assert sent.task(1, "room", [1, 2])["stored"] == 0  # done: the next fault is the first
    with pytest.raises(Retry):
        sent.task(1, "room", [1, 2])
    assert 1 <= pauses[-1] <= 2


def test_a_message_comes_back_when_it_cannot_be_sent_again(
    monkeypatch: pytest.MonkeyPatch, pauses: list[float]
) -> None:
    sent = Sent(monkeypatch, ITEMS_TASK)

    def refuse(**_: Any) -> Retry:
        raise Reject("the broker is gone", requeue=False)

    def no_broker(*_: Any, **__: Any) -> None:
        raise BrokerError("gone")

    monkeypatch.setattr(sent.task, "retry", refuse)
    monkeypatch.setattr(again, "send_items", no_broker)
    outcomes = (ModelError("x"), DatabaseUnavailableError("y"), ChunkOutcome(left=(2,)), ChunkOutcome(held=(2,)))
    monkeypatch.setattr(tasks, "_workplaces", [Place(*outcomes)])
    for _ in outcomes:
        with pytest.raises(Reject) as caught:
            sent.task(1, "room", [1, 2])
        assert caught.value.requeue is True


def test_what_is_left_is_sent_on_and_what_is_held_later(monkeypatch: pytest.MonkeyPatch, pauses: list[float]) -> None:
    messages: list[tuple[Any, ...]] = []
    monkeypatch.setattr(again, "send_items", lambda *given, delay_s=None: messages.append((*given, delay_s)))
    monkeypatch.setattr(tasks, "_workplaces", [Place(ChunkOutcome(stored=1, left=(2, 3), held=(4,)))])
    assert app.tasks[ITEMS_TASK](7, "room", [1, 2, 3, 4])["stored"] == 1
    assert messages == [(7, "room", (2, 3), None), (7, "room", (4,), 60)]


@pytest.mark.parametrize(
    ("error", "retries", "pause"),
    [
        (DatabaseUnavailableError("down"), 0, (1, 2)),
        (DatabaseUnavailableError("down"), 50, (150, 300)),
        (SoftTimeLimitExceeded(), 1, (2, 4)),
        (BrokerError("gone"), 0, (1, 2)),
        (UsageError("no detector"), 9, (150, 300)),
        (ProvenanceError("other models"), 50, (0, 0)),
    ],
)
def test_a_recording_that_cannot_be_planned_now_is_tried_again(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    pauses: list[float],
    error: Exception,
    retries: int,
    pause: tuple[float, float],
) -> None:
    sent = Sent(monkeypatch, INGEST_TASK, retries)

    def fail(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(tasks, "queue_recordings", fail)
    with pytest.raises(Retry):
        sent.task(str(tmp_path))
    [made] = sent.pauses
    assert pause[0] <= made <= pause[1]
    assert len(pauses) == isinstance(error, ProvenanceError)


def test_a_recording_that_no_worker_can_plan_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = Sent(monkeypatch, INGEST_TASK, retries=tasks.PLAN_TRIES)
    with pytest.raises(RecordingError, match="the folder is empty"):
        sent.task(str(tmp_path))
    with pytest.raises(Retry):  # a mount may come back
        sent.task(str(tmp_path / "away"))
    assert len(sent.pauses) == 1


def test_a_plan_is_not_begun_by_a_worker_that_is_to_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sent = Sent(monkeypatch, INGEST_TASK)
    monkeypatch.setattr(stopping, "is_set", lambda: True)
    with pytest.raises(Retry):
        sent.task(str(tmp_path))
    assert sent.pauses == [0.0]


def test_a_pause_ends_when_the_worker_is_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stopping, "is_set", lambda: True)
    started = time.monotonic()
    again._pause(60)
    assert time.monotonic() - started < 1


def test_tasks_have_limits_and_their_messages_outlive_them() -> None:
    for name in (ITEMS_TASK, INGEST_TASK):
        task = app.tasks[name]
        assert (task.soft_time_limit, task.time_limit, task.max_retries) == (SOFT_LIMIT_S, HARD_LIMIT_S, None)
        assert task.acks_late
        assert task.reject_on_worker_lost
        assert task.acks_on_failure_or_timeout is False


@pytest.mark.parametrize(
    ("url", "what"),
    [
        ("foo://x", "no broker of the kind 'foo'"),
        ("redis://:secret@h:abc/0", "host or port make no sense"),
        ("redis://:secret@h:99999/0", "host or port make no sense"),
        ("redis://:secret@h:1/first", "is a number"),
        ("nonsense", "is no URL"),
        ("", "is no URL"),
    ],
)
def test_a_broker_that_makes_no_sense_is_a_usage_error_and_a_finding(tmp_path: Path, url: str, what: str) -> None:
    with pytest.raises(UsageError, match=what) as caught:
        Settings(broker_url=url)
    assert "secret" not in str(caught.value)
    [finding] = [check for check in doctor(tmp_path, url) if check["what"] == "broker"]
    assert finding["state"] == "problem"
    assert what in finding["text"]


def doctor(folder: Path, broker_url: str) -> list[dict[str, str]]:
    database = f"sqlite:///{folder / 'none.sqlite3'}"
    runner = CliRunner()
    result = runner.invoke(
        cli, ["doctor", "--json"], env={"SEMDB_BROKER_URL": broker_url, "SEMDB_DATABASE_URL": database}
    )
    assert result.exit_code == 1
    found: list[dict[str, str]] = json.loads(result.stdout)
    return found


@pytest.mark.parametrize("command", [["ingest", "--resume"], ["status"]])
def test_commands_end_with_2_at_a_broker_that_makes_no_sense(command: list[str]) -> None:
    result = CliRunner().invoke(cli, command, env={"SEMDB_BROKER_URL": "redis://h:abc/0"})
    assert result.exit_code == 2
    assert result.stderr.splitlines() == [
        "semdb: SEMDB_BROKER_URL: host or port make no sense: write redis://HOST:PORT/N"
    ]


@pytest.mark.parametrize(
    "url",
    ["rediss://:p%23w@h:6380/2?ssl_cert_reqs=required", "sentinel://a:1;sentinel://b:2", "sqla+sqlite:///x", "amqp://"],
)
def test_brokers_of_celery_are_taken_as_they_are(url: str) -> None:
    assert Settings(broker_url=url).broker_url == url


def test_the_task_refuses_options_that_it_does_not_know() -> None:
    with pytest.raises(UsageError, match="no option 'speed'"):
        ingest_recording.apply(args=["nowhere"], kwargs={"options": {"speed": 3}}, throw=True)
    with pytest.raises(UsageError, match="'stride' is '3', not of type int"):
        ingest_recording.apply(args=["nowhere"], kwargs={"options": {"stride": "3"}}, throw=True)


def test_without_the_extra_the_import_says_what_to_install() -> None:
    code = "import sys; sys.modules['celery'] = None; import semdb.workers"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].endswith("semdb.workers needs the worker extra: pip install 'semdb[worker]'")
