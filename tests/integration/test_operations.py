"""What an operator sees of workers: metrics on a port, who is idle, whether the broker answers; limits of tasks."""

from __future__ import annotations

import re
import urllib.request
from pathlib import Path
from typing import Any

import pytest
from celery.exceptions import Retry, SoftTimeLimitExceeded

from semdb.cli.doctor import broker as check_broker
from semdb.database import items
from semdb.database.store import open_store
from semdb.ingestion.queue import Workplace, queue_recordings
from semdb.ingestion.run import IngestOptions
from semdb.ingestion.work import Item
from semdb.settings import Settings
from semdb.workers import HARD_LIMIT_S, ITEMS_TASK, SOFT_LIMIT_S, VISIBILITY_S, BrokerError, nodes, tasks
from tests import services
from tests.integration.test_queue import Outbox, settings
from tests.rooms import semdb

SPECS = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}


def scrape(port: int) -> dict[str, float]:
    """What a worker answers on its port: values by name and labels."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as answer:
        lines = [line for line in answer.read().decode().splitlines() if not line.startswith("#")]
    return {name: float(value) for name, _, value in (line.rpartition(" ") for line in lines)}


def counts(found: dict[str, float]) -> list[float]:
    return [value for name, value in found.items() if name.startswith("semdb_keyframes_total")]


def test_metrics_idle_workers_and_the_broker(room: Path, tmp_path: Path) -> None:
    url, port = f"sqlite:///{tmp_path / 'a.sqlite3'}", services.free_port()
    broken = tmp_path / "room"
    broken.mkdir()
    for part in sorted(room.iterdir()):
        (broken / part.name).symlink_to(part)
    (broken / "rgb").unlink()
    (broken / "rgb").mkdir()
    for number, image in enumerate(sorted((room / "rgb").iterdir())):
        data = bytearray(image.read_bytes())
        if number == 8:
            data[len(data) // 2] ^= 0xFF
        (broken / "rgb" / image.name).write_bytes(data)
    with services.redis(tmp_path) as broker:
        where = {"SEMDB_BROKER_URL": broker.url, **SPECS}
        worker = services.start_worker(
            tmp_path, url, broker.url, processes=2, SEMDB_METRICS_PORT=str(port), SEMDB_LOG_FORMAT="json", **SPECS
        )
        with services.workers(worker):
            arguments = ("ingest", broken, "--queue", "--stride", 4, "--map", "m")
            queued = semdb(*arguments, url=url, cwd=None, **where)
            assert queued.returncode == 0, queued.stderr
            with open_store(url) as store:
                services.wait_until(lambda: items.left(store.engine, 1) == (0, 0), "all are done")
            services.wait_until(lambda: sum(counts(scrape(port))) == 6, "all are counted")
            found = scrape(port)
            assert found['semdb_keyframes_total{outcome="stored"}'] == 5
            assert found['semdb_keyframes_total{outcome="failed"}'] == 1
            for stage in ("read", "detect", "encode", "features", "store"):
                assert 0 < found[f'semdb_stage_seconds_total{{stage="{stage}"}}'] < 600

            [node] = nodes(Settings(broker_url=broker.url))
            assert sorted(node.processes) == sorted(worker.children())
            shown = semdb("status", url=url, cwd=None, **where)
            assert re.search(r"^worker celery@.*: 2 of 2 processes idle$", shown.stdout, re.MULTILINE), shown.stdout
            assert "processes idle" not in semdb("status", url=url).stdout  # no broker is set
            assert [check.state for check in check_broker(Settings(broker_url=broker.url))] == ["ok"]
            worker.process.terminate()
            assert worker.process.wait(30) == 0
        assert "workers: none answers at the broker" in semdb("status", url=url, cwd=None, **where).stdout
        broker.kill()
        gone = semdb("status", url=url, cwd=None, **where)
        assert gone.returncode == 0
        assert re.search(rf"^workers: the broker redis://.*:{broker.port}/0 does not answer", gone.stdout, re.M)


def test_doctor_says_what_is_wrong_with_the_broker() -> None:
    address = f"redis://:secret-word@127.0.0.1:{services.free_port()}/0"
    [silent] = check_broker(Settings(broker_url=address))
    assert silent.state == "problem"
    assert "does not answer" in silent.text
    assert "start it, or set SEMDB_BROKER_URL" in silent.text
    assert "secret-word" not in silent.text
    with pytest.raises(BrokerError, match="does not answer") as caught:
        nodes(Settings(broker_url=address))
    assert "secret-word" not in str(caught.value)
    [unset] = check_broker(Settings())
    assert (unset.state, unset.what) == ("info", "broker")


def test_a_task_has_limits_and_its_message_outlives_them() -> None:
    task = tasks.app.tasks[ITEMS_TASK]
    assert (task.soft_time_limit, task.time_limit) == (SOFT_LIMIT_S, HARD_LIMIT_S)
    assert SOFT_LIMIT_S < HARD_LIMIT_S < VISIBILITY_S
    assert task.max_retries is None  # what may heal is tried until it does


def test_a_task_that_takes_too_long_gives_back_what_it_holds(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The limit comes as an exception wherever the task's thread is: here after its second keyframe."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    outbox, own = Outbox(), settings(url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=4, map_name="m"), outbox.send)
    done: list[int] = []

    def slow(_recording: int, item: Item) -> None:
        done.append(item.claim.frame_index)
        if len(done) == 2:
            raise SoftTimeLimitExceeded

    delays: list[Any] = []

    def again(**given: Any) -> Retry:
        delays.append(given["countdown"])
        return Retry()

    monkeypatch.setattr(tasks, "_workplaces", [Workplace(own)])
    monkeypatch.setattr(tasks, "log_item", slow)
    task = tasks.app.tasks[ITEMS_TASK]
    monkeypatch.setattr(task, "retry", again)
    with pytest.raises(Retry):
        task(*outbox[0])
    with open_store(url) as store:
        pending, running = items.left(store.engine, 1)
        stored = store.status()[0].keyframes
        assert running == 0
        assert 2 <= stored < 6
        assert pending == 6 - stored
        assert len(delays) == 1
        assert 1 <= delays[0] <= 2
        assert task(*outbox[0]) == {"stored": pending, "failed": 0, "lost": 0, "left": 0}
        assert store.status()[0].keyframes == 6
