"""What is wrong in one frame, or one message, is failed or refused once, with one line, and holds up nothing else."""

from __future__ import annotations

import base64
import dataclasses
import json
import socket
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semdb.database.items import open_items
from semdb.database.store import open_store
from semdb.errors import UsageError
from semdb.ingestion import work
from semdb.ingestion.queue import Workplace, queue_recordings
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.ingestion.work import Item
from semdb.perception.describe import Describer
from semdb.recordings.base import FrameEntry, Recording
from semdb.types import Description, Frame
from semdb.workers import INGEST_TASK, ITEMS_TASK, make_app
from tests import services
from tests.database_samples import PNG
from tests.integration.comparison import is_complete, stored
from tests.integration.test_queue import Outbox, settings
from tests.integration.test_workers_faults import start
from tests.rooms import semdb

NAN = float("nan")
CATEGORIES = {0: "chair ", 1: "a\x1b[31mb", 2: "x" * 256, 3: "\udce9", 4: "", 5: "two\nlines"}
LARGE, TOO_LATE, NO_POSE, BAD_BOX, BAD_SCORE, UNREADABLE, UNDESCRIBABLE = 6, 7, 8, 9, 10, 11, 12
MARK = 13  # of every pixel of the image that no network can take


class Poison:
    """Frames that become what they must not be on the way from the file to the database."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._read, self._take = Recording.read, work._take
        self._describe, self._describe_batch = Describer.describe, Describer.describe_batch
        monkeypatch.setattr(Recording, "read", lambda *given: self.read(*given))  # noqa: PLW0108 (a method, for it to be bound)
        monkeypatch.setattr(work, "_take", self.take)
        monkeypatch.setattr(Describer, "describe", lambda *given: self.describe(*given))  # noqa: PLW0108 (a method, for it to be bound)
        monkeypatch.setattr(Describer, "describe_batch", lambda *given: self.describe_batch(*given))  # noqa: PLW0108 (a method, for it to be bound)

    def read(self, recording: Recording, entry: FrameEntry) -> Frame:
        if entry.index == UNREADABLE:
            raise ValueError("embedded \x1b[31m\nnull byte")
        frame = self._read(recording, entry)
        if entry.index == UNDESCRIBABLE:
            return dataclasses.replace(frame, image=np.full_like(frame.image, MARK))
        return frame

    def describe(self, describer: Describer, image: Any, *given: Any) -> Description:
        if (image == MARK).all():
            raise cv2.error("OpenCV: assertion failed")
        return self._describe(describer, image, *given)

    def describe_batch(self, describer: Describer, views: Any) -> list[Description]:
        if any((view.image == MARK).all() for view in views):
            raise cv2.error("OpenCV: assertion failed")
        return list(self._describe_batch(describer, views))

    def take(self, item: Item, description: Description) -> None:
        index, frame = item.claim.frame_index, item.frame
        assert frame is not None
        if index == LARGE:
            item.frame = dataclasses.replace(frame, image_bytes=PNG + bytes(17 * 2**20))
        elif index == TOO_LATE:
            item.frame = dataclasses.replace(frame, timestamp_ns=2**70)
        elif index == NO_POSE:
            item.frame = dataclasses.replace(frame, world_from_camera=np.full((4, 4), NAN))
        first, *others = description.detections
        if index in CATEGORIES:
            first = dataclasses.replace(first, category=CATEGORIES[index])
        elif index == BAD_BOX:
            first = dataclasses.replace(first, box=np.array([NAN, 0, 1, 1], np.float32))
        elif index == BAD_SCORE:
            first = dataclasses.replace(first, score=NAN)
        self._take(item, dataclasses.replace(description, detections=(first, *others)))


def test_a_poisoned_frame_is_failed_and_the_others_are_stored(
    room: Path, database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poison = pytest.MonkeyPatch()
    Poison(poison)
    try:
        [summary] = ingest_recordings([room], settings(database_url, tmp_path), IngestOptions(stride=1, map_name="m"))
    finally:
        poison.undo()
    takes_all_sizes = database_url.startswith("sqlite")
    bad = set(range(13)) - ({LARGE} if takes_all_sizes else set())
    assert set(summary.failed) == bad
    assert summary.stored == 24 - len(bad)
    assert all(reason.isprintable() for reason in summary.failed.values())
    for index, reason in (
        (0, "has a space at an end"), (1, "a character that cannot be printed"), (2, "has 256 characters"),
        (4, "is empty"), (NO_POSE, "finite 4x4 pose"), (BAD_BOX, "score and box of an object are finite"),
        (BAD_SCORE, "score and box"), (UNREADABLE, r"ValueError: embedded \x1b[31m\nnull byte"),
        (UNDESCRIBABLE, "OpenCV: assertion failed"),
    ):  # fmt: skip
        assert reason in summary.failed[index]
        assert summary.failed[index].startswith("rgb/")
    if not takes_all_sizes:
        assert "raise max_allowed_packet on the server" in summary.failed[LARGE]
    # the cause gone, and put back, they are stored
    done = semdb("retry", url=database_url)
    assert f"{len(bad)} put back" in done.stdout
    [summary] = ingest_recordings([room], settings(database_url, tmp_path), IngestOptions(stride=1, map_name="m"))
    assert (summary.failed, summary.stored, summary.already_stored) == ({}, len(bad), 24 - len(bad))


def test_a_fault_of_the_networks_fails_no_frame(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"

    def broken(*_: Any) -> None:
        raise cv2.error("no device")

    monkeypatch.setattr(Describer, "describe", broken)
    monkeypatch.setattr(Describer, "describe_batch", broken)
    with pytest.raises(cv2.error, match="no device"):
        ingest_recordings([room], settings(url, tmp_path), IngestOptions(stride=1, map_name="m"))
    with open_store(url) as store:
        assert store.failed_items() == []
        assert len(open_items(store.engine, 1, range(24))) == 24


def test_keyframes_are_given_up_that_nobody_has(room: Path, database_url: str, tmp_path: Path) -> None:
    outbox, own = Outbox(), settings(database_url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=4, map_name="m"), outbox.send)
    place = Workplace(own)
    frames = outbox[0][2]
    with open_store(database_url) as store:
        from semdb.database import items

        [mine] = items.claim(store.engine, 1, items.worker_name(), limit=1)
        assert place.give_up(1, frames, "is \x1b[31mbroken") == len(frames) - 1
        failed = store.failed_items()
        assert {item.error for item in failed} == {r"is \x1b[31mbroken"}
        assert mine.frame_index not in {item.frame_index for item in failed}
        assert place.give_up(1, frames, "again") == 0


def test_where_a_recording_is_says_the_database_and_not_the_message(
    room: Path, database_url: str, tmp_path: Path
) -> None:
    outbox, own = Outbox(), settings(database_url, tmp_path)
    queue_recordings([str(room)], own, IngestOptions(stride=8, map_name="m"), outbox.send)
    assert Workplace(own).do(1, "/etc", outbox[0][2]).stored == 3
    elsewhere = own.model_copy(update={"recording_roots": str(tmp_path)})
    queue_recordings([str(room)], own, IngestOptions(stride=12, map_name="n"), outbox.send)
    with pytest.raises(UsageError, match="SEMDB_RECORDING_ROOTS"):
        Workplace(elsewhere).do(*outbox[-1])


def push(port: int, body: Any, headers: Any, content_type: str = "application/json") -> None:
    """Puts a message into the queue of the broker as anybody who reaches it can, past Celery."""
    text = body if isinstance(body, bytes) else json.dumps(body).encode()
    message = {
        "body": base64.b64encode(text).decode(),
        "content-encoding": "utf-8",
        "content-type": content_type,
        "headers": headers,
        "properties": {
            "body_encoding": "base64", "correlation_id": "c", "delivery_mode": 2, "priority": 0,
            "delivery_tag": f"tag-{time.monotonic_ns()}", "delivery_info": {"exchange": "", "routing_key": "semdb"},
        },
    }  # fmt: skip
    redis(port, "LPUSH", "semdb", json.dumps(message))


def redis(port: int, *words: str | bytes) -> bytes:
    """What Redis answers, as it writes it."""
    parts = [f"*{len(words)}\r\n".encode()]
    for word in words:
        data = word if isinstance(word, bytes) else word.encode()
        parts.append(b"$%d\r\n%s\r\n" % (len(data), data))
    with socket.create_connection(("127.0.0.1", port), 5) as connection:
        connection.sendall(b"".join(parts))
        return connection.recv(4096)


def test_a_worker_among_poisoned_messages_does_its_work(room: Path, tmp_path: Path) -> None:
    """Each is refused with one line at once, none comes again, and a recording sent after them all is done."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    good = tmp_path / "recordings" / "room"
    good.parent.mkdir()
    good.symlink_to(room)
    outside, broken = tmp_path / "outside", tmp_path / "recordings" / "broken"
    broken.mkdir()
    for entry in room.iterdir():
        (broken / entry.name).symlink_to(entry)
    (broken / "rgb.txt").unlink()
    (broken / "rgb.txt").write_text("1.0 rgb/\0.png\n")
    outside.mkdir()
    roots = f"{tmp_path}/recordings:{room.parent}"
    specs = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        sender = make_app(settings(url, tmp_path).model_copy(update={"broker_url": broker.url}))
        refused: list[tuple[str, list[Any]]] = [
            (ITEMS_TASK, []), (ITEMS_TASK, ["1", "x", [1]]), (ITEMS_TASK, [1, "x", {"a": 1}]),
            (ITEMS_TASK, [1, "x", list(range(5000))]), (ITEMS_TASK, [2**80, "x", [1]]), (ITEMS_TASK, [1, "a\0", [1]]),
            (ITEMS_TASK, [True, None, None]), (INGEST_TASK, [None]), (INGEST_TASK, ["a\0b"]),
            (INGEST_TASK, [str(outside)]), (INGEST_TASK, ["/etc"]),
            (INGEST_TASK, [str(good), "m\x1b[31m"]), (INGEST_TASK, [str(good), "m", "n", {"keyframes": "3"}]),
            (INGEST_TASK, [str(broken)]),
        ]  # fmt: skip
        for task, arguments in refused:
            sender.send_task(task, args=arguments)
        own = {"lang": "py", "task": ITEMS_TASK}
        nothing: list[tuple[Any, dict[str, Any]]] = [
            (b"[" * 100_000, {**own, "id": "deep"}),
            (b"no json", {**own, "id": "text"}),
            ({"no": "arguments"}, {**own, "id": "shape"}),
            ([[], 5, {}], {**own, "id": "no names"}),
            ([[], {}, {"chain": 5}], {**own, "id": "no chain"}),
            ([1, 2, 3, 4], {**own, "id": "numbers"}),
            ([[], {}, {}], {**own, "id": "unknown", "task": "os.system"}),
            ([[], {}, {}], {**own, "id": "list", "task": [ITEMS_TASK]}),
            ([[], {}, {}], {**own, "id": "none", "task": None}),
            ([[], {}, {}], {**own, "id": ["a"]}),
            ([[], {}, {}], {"id": "no task"}),
            ([[], {}, {}], {**own, "id": "when", "eta": "tomorrow \x1b[31m"}),
        ]
        for body, headers in nothing:
            push(broker.port, body, headers)
        pickled = b"\x80\x04\x8c\x05posix\x94."
        push(broker.port, pickled, {**own, "id": "pickle"}, "application/x-python-serialize")
        push(broker.port, [[], {}, {}], {**own, "id": "limit", "timelimit": "soon", "retries": "many"})
        odd = ("semdb_failures", "root_id", "group", "stamped_headers", "stamps", "shadow", "origin", "chord")
        for name in odd:
            push(broker.port, [[77, "x", [1]], {}, {}], {**own, "id": f"odd {name}", name: [["x"]]})
        sender.send_task(ITEMS_TASK, args=[77, "x", [1]])  # of a recording that is not there
        sender.send_task(INGEST_TASK, args=[str(good), "m", None, {"stride": 4}])
        started = time.monotonic()
        worker = services.start_worker(tmp_path, url, broker.url, SEMDB_RECORDING_ROOTS=roots, **specs)
        with services.workers(worker):
            services.wait_until(lambda: stored(store) == 6 and is_complete(store), "the good recording is stored", 60)
            seconds = time.monotonic() - started
            text = worker.text()
            assert text.count("given_up") == len(refused) + len(nothing) + 2, text
            assert text.count("dropped recording=77") == len(odd) + 1
            assert "Traceback" not in text
            assert "\x1b[31m" not in text
            services.wait_until(lambda: redis(broker.port, "LLEN", "semdb") == b":0\r\n", "no message is left")
            services.wait_until(lambda: redis(broker.port, "HLEN", "unacked") == b":0\r\n", "none is in hand")
            assert "refused" not in text  # none was sent again
        assert seconds < 60
        assert store.failed_items() == []
        assert [info.name for info in store.maps()] == ["m"]


def test_a_worker_among_rubbish_does_its_work(room: Path, tmp_path: Path) -> None:
    """What is no message at all, in the list, among what workers have in hand, and in what all of them listen to."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    specs = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}
    right = {
        "body": base64.b64encode(b"[[],{},{}]").decode(), "content-encoding": "utf-8",
        "content-type": "application/json", "headers": {},
        "properties": {
            "body_encoding": "base64", "delivery_tag": "t", "delivery_info": {"exchange": "", "routing_key": "semdb"},
        },
    }  # fmt: skip

    def changed(**properties: Any) -> str:
        return json.dumps({**right, "properties": {**right["properties"], **properties}})  # type: ignore[dict-item]

    rubbish = [
        "rubbish", "", "5", "null", "[]", "{}", '{"properties": 5}', '{"properties": {}}', '"x"', "[" * 100_000,
        b"\xff\xfe\x00", '{"__type__": "datetime", "__value__": 5}', '{"__type__": "decimal", "__value__": "x"}',
        changed(delivery_tag=None), changed(delivery_tag=["a"]), changed(delivery_tag="\ud800"),
        changed(delivery_info=None), changed(delivery_info={}), changed(body_encoding="rot13"),
        json.dumps({**right, "body": 5}), json.dumps({**right, "body": "a"}), json.dumps({**right, "headers": [1]}),
        json.dumps({**right, "content-type": {}}), json.dumps({**right, "headers": {"compression": "zlib"}}),
    ]  # fmt: skip
    with services.redis(tmp_path) as broker, open_store(url, create=True) as store:
        sender = make_app(settings(url, tmp_path).model_copy(update={"broker_url": broker.url}))
        for item in rubbish:
            assert redis(broker.port, "LPUSH", "semdb", item).startswith(b":")
        in_hand = ["rubbish", "{}", "[1, 2, 3]", '[{"headers": 5}, "", "semdb"]', b"\xff"]
        for number, item in enumerate(in_hand):
            redis(broker.port, "HSET", "unacked", f"tag{number}", item)
            redis(broker.port, "ZADD", "unacked_index", str(number + 1), f"tag{number}")
        worker = services.start_worker(tmp_path, url, broker.url, **specs)
        with services.workers(worker):
            services.wait_until(
                lambda: worker.text().count("given_up") >= len(rubbish) + len(in_hand), "all are refused"
            )
            assert "Traceback" not in worker.text(), worker.text()
            for item in ("rubbish", "5", "{}", changed(), '{"properties": {"delivery_tag": 5}}'):
                assert redis(broker.port, "PUBLISH", "/0.celery.pidbox", item) == b":1\r\n"  # it listens
            sender.send_task(INGEST_TASK, args=[str(room), "m", None, {"stride": 4}])
            services.wait_until(lambda: stored(store) == 6 and is_complete(store), "the good recording is stored", 60)
            services.wait_until(lambda: redis(broker.port, "LLEN", "semdb") == b":0\r\n", "no message is left")
            services.wait_until(lambda: redis(broker.port, "HLEN", "unacked") == b":0\r\n", "none is in hand", 60)


KILLS = """
import os
import semdb.workers.again, semdb.workers.tasks
semdb.workers.again.MOST_LOSSES = 3
semdb.workers.tasks._plan = lambda *_: os.kill(os.getpid(), 9)
"""


def test_a_message_over_which_workers_die_is_given_up(room: Path, tmp_path: Path) -> None:
    """Whatever kills a process, a picture of gigapixels for one: Celery gives such a message back without a count."""
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with services.redis(tmp_path) as broker, open_store(url, create=True):
        sender = make_app(settings(url, tmp_path).model_copy(update={"broker_url": broker.url}))
        sender.send_task(INGEST_TASK, args=[str(room)])
        with services.workers(start(tmp_path, url, broker.url, KILLS)) as [worker]:
            services.wait_until(lambda: "given_up" in worker.text(), "it is given up")
            assert worker.text().count("signal 9 (SIGKILL)") >= 2
            assert "error=LostWorkerError: workers were lost 3 times over this message" in worker.text()
            services.wait_until(lambda: redis(broker.port, "HLEN", "unacked") == b":0\r\n", "none is in hand")
            assert redis(broker.port, "LLEN", "semdb") == b":0\r\n"
