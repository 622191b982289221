"""The Celery application: its settings, its tasks, and what is said without the extra."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from celery.exceptions import Ignore, Reject, Retry, SoftTimeLimitExceeded
from hypothesis import given
from hypothesis import settings as settings_of_hypothesis
from hypothesis import strategies as st
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
from semdb.workers.messages import ItemsMessage, items_message, plan_message
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
    """Stands for `retry` of a task: pauses with which messages were sent again, and their last headers."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, name: str, retries: int = 0) -> None:
        self.task = app.tasks[name]
        self.pauses: list[float] = []
        self.headers: dict[str, int] = {}
        monkeypatch.setattr(self.task, "retry", self)
        monkeypatch.setattr(self.task.request, "retries", retries)

    def __call__(self, *, countdown: float, headers: dict[str, int], **_: Any) -> Retry:
        self.pauses.append(countdown)
        self.headers = headers
        return Retry()


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Pauses that this process made."""
    made: list[float] = []
    monkeypatch.setattr(again, "_pause", made.append)
    monkeypatch.setattr(again, "_faults", [])
    return made


@pytest.fixture
def given_up(caplog: pytest.LogCaptureFixture) -> Iterator[Callable[[], list[str]]]:
    """The lines of messages that were given up, each as the log has it."""
    with caplog.at_level(logging.ERROR, "semdb"):
        yield lambda: [r.getMessage() for r in caplog.records if r.getMessage().startswith("given_up")]


class Place:
    """A workplace of which `do` raises, or returns, what it is told."""

    def __init__(self, *outcomes: object) -> None:
        self.outcomes = list(outcomes)
        self.given_up: list[tuple[Any, ...]] = []

    def give_up(self, *what: Any) -> None:
        self.given_up.append(what)

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
        (UsageError("no detector"), 9, (1, 2)),
        (ValueError("a bug"), 9, (1, 2)),
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


def test_a_recording_that_no_worker_can_plan_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pauses: list[float], given_up: Callable[[], list[str]]
) -> None:
    sent = Sent(monkeypatch, INGEST_TASK)

    def refuse(*_: Any, **__: Any) -> None:
        raise UsageError("it is stored already and is another one")

    monkeypatch.setattr(tasks, "queue_recordings", refuse)
    for failures in range(again.MOST_FAILURES - 1):
        with pytest.raises(Retry):
            sent.task(str(tmp_path))
        assert 2.0**failures <= sent.pauses[-1] <= 2.0 ** (failures + 1) or sent.pauses[-1] >= 150
        assert sent.headers == {again.FAILURES: failures + 1, again.LOSSES: 0}
        monkeypatch.setitem(sent.task.request.__dict__, again.FAILURES, failures + 1)
    with pytest.raises(Ignore):
        sent.task(str(tmp_path))
    [line] = given_up()
    assert line.startswith(f"given_up path={tmp_path} task=semdb.ingest_recording error=UsageError: it is stored")
    assert pauses == []  # no other message waits


def test_a_recording_that_cannot_be_read_is_refused_once_and_a_lost_mount_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given_up: Callable[[], list[str]]
) -> None:
    monkeypatch.setenv("SEMDB_DATABASE_URL", f"sqlite:///{tmp_path / 'a.sqlite3'}")
    sent = Sent(monkeypatch, INGEST_TASK)
    room = tmp_path / "room"
    write_synthetic_recording(room, SyntheticOptions(frames=2, width=64, height=48))
    classes = json.loads((room / "masks" / "classes.json").read_text())
    for name in ("chair ", "a\x1b[31mb", "\n", "x" * 256, "", "\ud800"):
        (room / "masks" / "classes.json").write_text(json.dumps({**classes, "1": name}))
        with pytest.raises(Ignore):
            sent.task(str(room))
        line = given_up()[-1]
        assert "masks/classes.json: the class name" in line
        assert line.isprintable()
    (room / "masks" / "classes.json").write_text(json.dumps(classes))
    (room / "rgb.txt").write_text("1.0 rgb/a\0.png\n")
    with pytest.raises(Ignore):
        sent.task(str(room))
    assert "no file can have this name: it holds a NUL" in given_up()[-1]
    assert len(given_up()) == 7
    (tmp_path / "mount").mkdir()
    for path in ("away", "mount"):  # not there; nothing mounted
        with pytest.raises(Retry):
            sent.task(str(tmp_path / path))
    assert len(given_up()) == 7


def test_no_message_is_tried_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pauses: list[float], given_up: Callable[[], list[str]]
) -> None:
    sent = Sent(monkeypatch, ITEMS_TASK, retries=again.MOST_TRIES)
    errors = (DatabaseUnavailableError("down"), ModelError("none"), SoftTimeLimitExceeded(), UsageError("no"))
    place = Place(*errors)
    monkeypatch.setattr(tasks, "_workplaces", [place])
    for _ in errors:
        with pytest.raises(Ignore):
            sent.task(1, "room", [1, 2])
    assert len(given_up()) == 4
    assert place.given_up == [(1, (1, 2), "no")]  # what may heal, or is of the worker, stays in the plan
    assert sent.pauses == pauses == []


def test_keyframes_that_every_worker_fails_at_are_failed_and_hold_up_nothing(
    monkeypatch: pytest.MonkeyPatch, pauses: list[float], given_up: Callable[[], list[str]]
) -> None:
    sent = Sent(monkeypatch, ITEMS_TASK)
    monkeypatch.setitem(sent.task.request.__dict__, again.FAILURES, again.MOST_FAILURES - 2)
    place = Place(RecordingError("is \x1b[31manother"), ValueError("embedded\nnull byte"))
    monkeypatch.setattr(tasks, "_workplaces", [place])
    with pytest.raises(Retry):
        sent.task(1, "room", [1, 2])
    monkeypatch.setitem(sent.task.request.__dict__, again.FAILURES, again.MOST_FAILURES - 1)
    with pytest.raises(Ignore):
        sent.task(1, "room", [1, 2])
    assert place.given_up == [(1, (1, 2), "ValueError: embedded\nnull byte")]
    assert [line.split("\n")[0] for line in given_up()] == [
        r"given_up recording=1 frames=2 task=semdb.ingest_items error=ValueError: embedded\nnull byte"
    ]
    assert pauses == []


def test_messages_over_which_workers_are_lost_are_counted_and_given_up(
    monkeypatch: pytest.MonkeyPatch, given_up: Callable[[], list[str]]
) -> None:
    sent = Sent(monkeypatch, ITEMS_TASK)
    place = Place()  # nothing is done of a message that came back: it is sent anew first
    monkeypatch.setattr(tasks, "_workplaces", [place])
    monkeypatch.setattr(sent.task.request, "delivery_info", {"redelivered": True})
    for losses in range(1, again.MOST_LOSSES):
        with pytest.raises(Retry):
            sent.task(1, "room", [1])
        assert sent.headers == {again.FAILURES: 0, again.LOSSES: losses}
        monkeypatch.setitem(sent.task.request.__dict__, again.LOSSES, losses)
    with pytest.raises(Ignore):
        sent.task(1, "room", [1])
    assert place.given_up == [(1, (1,), f"workers were lost {again.MOST_LOSSES} times over this message")]
    assert len(given_up()) == 1


def test_a_count_that_is_no_number_counts_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    sent = Sent(monkeypatch, ITEMS_TASK)
    for value in ("many", -5, None, [1]):
        monkeypatch.setitem(sent.task.request.__dict__, again.FAILURES, value)
        assert again._header(sent.task, again.FAILURES) == 0


POISON_ITEMS: list[tuple[list[Any], dict[str, Any]]] = [
    ([], {}), ([1], {}), ([1, "x"], {}), ([1, "x", [1], 4], {}), ([1, "x", [1]], {"frames": [1]}),
    ([1, "x", [1]], {"hurry": True}), (["1", "x", [1]], {}), ([1.5, "x", [1]], {}), ([True, "x", [1]], {}),
    ([None, "x", [1]], {}), ([{}, "x", [1]], {}), ([[], "x", [1]], {}), ([-1, "x", [1]], {}), ([0, "x", [1]], {}),
    ([2**63, "x", [1]], {}), ([10**5000, "x", [1]], {}), ([1, None, [1]], {}), ([1, 5, [1]], {}), ([1, "", [1]], {}),
    ([1, "a\0b", [1]], {}), ([1, "x" * 5000, [1]], {}), ([1, "x", None], {}), ([1, "x", 5], {}), ([1, "x", "12"], {}),
    ([1, "x", {"0": 1}], {}),
    ([1, "x", ["1"]], {}), ([1, "x", [1.0]], {}), ([1, "x", [None]], {}), ([1, "x", [[1]]], {}),
    ([1, "x", [True]], {}), ([1, "x", [-1]], {}), ([1, "x", [2**31]], {}), ([1, "x", [10**400]], {}),
    ([1, "x", [float("nan")]], {}), ([1, "x", list(range(100_000))], {}),
]  # fmt: skip
POISON_PLANS: list[tuple[list[Any], dict[str, Any]]] = [
    ([], {}), ([None], {}), ([5], {}), ([""], {}), (["a\0b"], {}), (["x" * 5000], {}), ([["x"]], {}), ([{}], {}),
    (["x", "m", "n", {}, 5], {}), (["x"], {"path": "y"}), (["x"], {"speed": 1}), (["x", 5], {}), (["x", ""], {}),
    (["x", "m "], {}), (["x", "m\n"], {}), (["x", "m" * 256], {}), (["x", "\udce9"], {}), (["x", None, 5], {}),
    (["x", None, "n\x1b[31m"], {}), (["x", None, None, []], {}), (["x", None, None, "keyframes"], {}),
    (["x"], {"options": {"speed": 3}}), (["x"], {"options": {"stride": "3"}}), (["x"], {"options": {"stride": True}}),
    (["x"], {"options": {"keyframes": 0}}), (["x"], {"options": {"keyframes": -5}}),
    (["x"], {"options": {"keyframes": 10**30}}), (["x"], {"options": {"keyframes": 2.5}}),
    (["x"], {"options": {"camera": "1,2"}}), (["x"], {"options": {"camera": 5}}),
    (["x"], {"options": {"camera": "nan,1,1,1"}}), (["x"], {"options": {"reading": "depth_scale=-1"}}),
    (["x"], {"options": {"reading": "no=1"}}), (["s3://a:secret@b/room"], {}),
]  # fmt: skip


@pytest.mark.parametrize(
    ("task", "given", "named"),
    [(ITEMS_TASK, *poison) for poison in POISON_ITEMS] + [(INGEST_TASK, *poison) for poison in POISON_PLANS],
)
def test_messages_that_make_no_sense_are_refused_once_with_one_line(
    monkeypatch: pytest.MonkeyPatch,
    pauses: list[float],
    caplog: pytest.LogCaptureFixture,
    task: str,
    given: list[Any],
    named: dict[str, Any],
) -> None:
    sent = Sent(monkeypatch, task)
    monkeypatch.setattr(tasks, "_workplaces", [Place()])  # nothing is done
    monkeypatch.setattr(tasks, "queue_recordings", lambda *_, **__: pytest.fail("it was planned"))
    with caplog.at_level(logging.DEBUG, "semdb"), pytest.raises(Ignore):
        sent.task(*given, **named)
    [record] = caplog.records
    assert record.levelno == logging.ERROR
    line = record.getMessage()
    assert line.startswith(f"given_up task={task} error=")
    assert line.isprintable()
    assert len(line) < 400
    assert "secret" not in line
    assert sent.pauses == pauses == []


@given(
    st.sampled_from([ITEMS_TASK, INGEST_TASK]),
    st.lists(st.recursive(st.none() | st.booleans() | st.floats() | st.integers() | st.text(), st.lists), max_size=5),
    st.dictionaries(st.sampled_from(["path", "frames", "source", "x"]), st.text() | st.integers(), max_size=3),
)
@settings_of_hypothesis(deadline=None, max_examples=300)
def test_any_message_is_understood_or_refused(task: str, given: list[Any], named: dict[str, Any]) -> None:
    given = json.loads(json.dumps(given))
    try:
        found = items_message(given, named) if task == ITEMS_TASK else plan_message(given, named, ())
    except UsageError:
        return
    if isinstance(found, ItemsMessage):
        assert found.recording_id == given[0]
        assert all(type(frame) is int for frame in found.frames)
    else:
        assert found.path == given[0] if given else named["path"]


def test_paths_outside_the_roots_are_refused_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given_up: Callable[[], list[str]]
) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path / "out")
    monkeypatch.setenv("SEMDB_RECORDING_ROOTS", f"{tmp_path}/in:s3://bucket/rooms")
    sent = Sent(monkeypatch, INGEST_TASK)
    planned: list[str] = []
    monkeypatch.setattr(tasks, "queue_recordings", lambda paths, *_, **__: planned.extend(paths) or [])
    outside = [
        f"{tmp_path}/out", "/", "/etc", f"{tmp_path}/in/../out", f"{tmp_path}/in/link", f"{tmp_path}/inside",
        "relative",
        f"file://{tmp_path}/out", f"file://{tmp_path}/in/%2e%2e/out", "s3://bucket/rooms/../secret", "s3://bucket/roomsX",
        "s3://bucket/rooms/%2e%2e/x", "s3://other/rooms/1", "http://169.254.169.254/latest", "memory://x",
        f"zip://a::file://{tmp_path}/in/a.zip", f"simplecache::file://{tmp_path}/in", f"local://{tmp_path}/out",
        "file://host/data",
    ]  # fmt: skip
    for path in outside:
        with pytest.raises(Ignore):
            sent.task(path)
    assert len(given_up()) == len(outside)
    assert all("SEMDB_RECORDING_ROOTS" in line or "file" in line for line in given_up())
    inside = [f"{tmp_path}/in", f"{tmp_path}/in/", "s3://bucket/rooms", "s3://bucket/rooms/1", f"file://{tmp_path}/in"]
    for path in inside:
        sent.task(path)
    assert planned == inside


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


def test_without_the_extra_the_import_says_what_to_install() -> None:
    code = "import sys; sys.modules['celery'] = None; import semdb.workers"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1].endswith("semdb.workers needs the worker extra: pip install 'semdb[worker]'")
