"""Thousands of messages as anybody may send them: the worker lives, and does what can be done meanwhile."""

from __future__ import annotations

import random
import time
from pathlib import Path
from typing import Any

import pytest

from semdb.database.store import open_store
from semdb.workers import INGEST_TASK, ITEMS_TASK, make_app
from tests import services
from tests.integration.test_poison import push, redis
from tests.integration.test_queue import settings

pytestmark = pytest.mark.long

MESSAGES = 3000
GOOD_EVERY = 500
SECONDS_FOR_A_GOOD_ONE = 60
TEXTS = (
    "",
    "x",
    "/etc",
    "a\0b",
    "\x1b[31m",
    "$\\frac{x$",
    "\ud800",
    "é" * 300,
    "semdb.ingest_items",
    "-1",
    "1e400",
    "{}",
)
NUMBERS = (0, 1, -1, 7, 2**31, 2**63, 10**400, 1.5, float("nan"), float("inf"))
HEADERS = (
    "id", "task", "eta", "expires", "retries", "timelimit", "group", "root_id", "parent_id", "argsrepr", "kwargsrepr",
    "origin", "lang", "shadow", "ignore_result", "stamps", "stamped_headers", "semdb_failures", "semdb_losses",
    "redelivered", "replaced_task_nesting", "chord", "headers", "delivery_info", "x",
)  # fmt: skip


def anything(chance: random.Random, depth: int = 0) -> Any:
    """A value that JSON can hold, or nearly."""
    kind = chance.randrange(8 if depth < 4 else 5)
    if kind == 0:
        return None
    if kind == 1:
        return chance.random() < 0.5
    if kind in (2, 3):
        return chance.choice(NUMBERS)
    if kind == 4:
        return chance.choice(TEXTS)
    if kind == 5:
        return {chance.choice(TEXTS): anything(chance, depth + 1) for _ in range(chance.randrange(4))}
    return [anything(chance, depth + 1) for _ in range(chance.randrange(5))]


def message(chance: random.Random, number: int) -> tuple[Any, dict[str, Any]]:
    """A body and headers: those of a right message with some of it changed."""
    body: Any = [[1, "x", [1]], {}, {"callbacks": None, "errbacks": None, "chain": None, "chord": None}]
    headers: dict[str, Any] = {"lang": "py", "task": chance.choice((ITEMS_TASK, INGEST_TASK)), "id": f"fuzz-{number}"}
    if chance.random() < 0.7:
        body[0] = anything(chance)
    if chance.random() < 0.3:
        body[1] = anything(chance)
    if chance.random() < 0.3:
        body[2] = anything(chance)
    if chance.random() < 0.2:
        body = anything(chance)
    for _ in range(chance.randrange(4)):
        headers[chance.choice(HEADERS)] = anything(chance)
    return body, headers


@pytest.mark.parametrize("seed", range(4))
def test_a_worker_among_thousands_of_strange_messages(room: Path, tmp_path: Path, seed: int) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    specs = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}
    chance = random.Random(seed)
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        sender = make_app(settings(url, tmp_path).model_copy(update={"broker_url": broker.url}))
        worker = services.start_worker(tmp_path, url, broker.url, SEMDB_RECORDING_ROOTS=str(room.parent), **specs)
        with services.workers(worker):
            for number in range(MESSAGES):
                push(broker.port, *message(chance, number))
                if number % GOOD_EVERY == GOOD_EVERY - 1:
                    name = f"good {number}"
                    sender.send_task(INGEST_TASK, args=[str(room), "m", name, {"keyframes": 2}])
                    began = time.monotonic()
                    services.wait_until(
                        lambda name=name: any(r.name == name and r.keyframes == 2 for r in store.status()),  # type: ignore[misc]
                        f"{name} is stored",
                        SECONDS_FOR_A_GOOD_ONE,
                    )
                    assert worker.process.poll() is None, worker.text()[-3000:]
                    print(f"{number + 1} messages, the good one took {time.monotonic() - began:.1f} s")
            services.wait_until(lambda: redis(broker.port, "LLEN", "semdb") == b":0\r\n", "no message is left", 120)
            text = worker.text()
        assert "Unrecoverable" not in text
        assert not any(ord(c) < 32 and c != "\n" for c in text)
        assert len(store.status()) == MESSAGES // GOOD_EVERY
        assert store.failed_items() == []
