"""One database in several threads and processes: what stays in memory is right, and there once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.api import Answer
from semdb.errors import NotFoundError
from semdb.types import Frame
from tests.integration.opened import MODELS, STRIDE, Opening, close_to, same
from tests.rooms import environment

OTHER = """
import semdb, sys
with semdb.open() as db:
    for line in sys.stdin:
        exec(line)
        print("done", flush=True)
"""


def test_another_process_is_followed(open_db: Opening, database_url: str, room: Path, frames: list[Frame]) -> None:
    """A database that is warm sees what another process ingests, refines and deletes, at its next question."""
    db = open_db()
    with pytest.raises(NotFoundError, match="holds no keyframe"):
        db.localize(frames[6])

    other = subprocess.Popen(
        [sys.executable, "-c", OTHER, str(room)],
        env=environment(database_url, **{f"SEMDB_{name.upper()}": value for name, value in MODELS.items()}),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

    def elsewhere(code: str) -> None:
        assert other.stdin is not None
        assert other.stdout is not None
        assert other.stderr is not None
        print(code, file=other.stdin, flush=True)
        assert other.stdout.readline() == "done\n", other.stderr.read()

    elsewhere("db.ingest(sys.argv[1], map='office', name='one', stride=8)")
    for coarse in ("index", "sql"):
        first = db.localize(frames[6], coarse=coarse)
        assert {candidate.recording for candidate in first.candidates} == {"one"}
        assert dict(first.refinements) == {"points": "none"}
    elsewhere("db.ingest(sys.argv[1], map='office', name='two', stride=2)")
    for coarse in ("index", "sql"):
        second = db.localize(frames[6], coarse=coarse)
        close_to(second, frames[6])
        assert "two" in {candidate.recording for candidate in second.candidates}
    elsewhere("db.refine('office')")
    for coarse in ("index", "sql"):
        assert dict(db.localize(frames[6], coarse=coarse).refinements) == {"points": "used"}
    elsewhere("db.delete(recording='two')")
    for coarse in ("index", "sql"):
        third = db.localize(frames[6], coarse=coarse)
        assert {candidate.recording for candidate in third.candidates} == {"one"}
        assert dict(third.refinements) == {"points": "stale"}
    elsewhere("db.delete(map='office'); db.ingest(sys.argv[1], map='office', name='three', stride=4)")
    for coarse in ("index", "sql"):
        fourth = db.localize(frames[6], map="office", coarse=coarse)
        assert {candidate.recording for candidate in fourth.candidates} == {"three"}
        assert dict(fourth.refinements) == {"points": "none"}
    elsewhere("db.delete(map='office')")
    with pytest.raises(NotFoundError, match="no map 'office'"):
        db.localize(frames[6], map="office")
    other.communicate()
    assert other.returncode == 0


def test_threads_may_share_it(open_db: Opening, room: Path, frames: list[Frame]) -> None:
    check_threads(open_db, room, frames, "surf")


@pytest.mark.parametrize("features", ["sift", "orb"])
def test_threads_may_share_opencvs_features(open_file: Opening, room: Path, frames: list[Frame], features: str) -> None:
    check_threads(open_file, room, frames, features)


def check_threads(open_db: Opening, room: Path, frames: list[Frame], features: str) -> None:
    """Answers do not depend on what other threads ask, or write, meanwhile."""
    db = open_db(features=features, threads=2)
    db.ingest(room, map="office", stride=STRIDE)
    asked = [frame for frame in frames if frame.index % STRIDE][:8]
    wanted = [db.localize(frame, map="office") for frame in asked]
    fresh = open_db(features=features, threads=2)
    together = threading.Barrier(4)
    mine = threading.local()

    def ask(number: int) -> Answer:
        if not hasattr(mine, "begun"):
            mine.begun = True
            together.wait(timeout=60)
        frame = asked[number % len(asked)]
        return fresh.localize(frame, map="office", coarse="index" if number % 3 else "sql")

    with ThreadPoolExecutor(4) as pool:
        found = [pool.submit(ask, number) for number in range(24)]
        other = pool.submit(fresh.ingest, room, map="another", stride=8)
        for number, answer in enumerate(found):
            assert same(answer.result(), wanted[number % len(asked)]), number
        assert other.result()[0].stored == 3
    assert {info.name: info.keyframes for info in fresh.maps()} == {"office": 6, "another": 3}


def test_a_forked_process_has_it_too(
    open_db: Opening, room: Path, frames: list[Frame], networks: dict[str, str]
) -> None:
    """Networks, connections, threads and locks of the parent are no trap to the child, nor the child's end to it."""
    db = open_db(**networks, threads=2)
    db.ingest(room, map="office", stride=STRIDE)
    frame = replace(frames[6], instances=None)
    wanted = db.localize(frame)
    cv2.SIFT.create().detectAndCompute(np.tile(frame.image[..., 0], (3, 3)), None)  # OpenCV has threads of its own now
    opencv_threads = cv2.getNumThreads()
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(120)  # a child that hangs ends with a signal
        try:
            found = db.localize(frame)
            db.ingest(room, map="child", stride=8)
            os.write(writing, b"same" if same(found, wanted) else b"other")
            db.close()
        except BaseException as error:
            os.write(writing, repr(error).encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading, "rb") as answer:
        assert answer.read() == b"same"
    assert os.waitpid(child, 0)[1] == 0
    assert cv2.getNumThreads() == opencv_threads
    assert same(db.localize(frame, map="office"), wanted)
    assert {info.name: info.keyframes for info in db.maps()} == {"office": 6, "child": 3}


def test_the_second_question_pays_only_for_itself(
    open_file: Opening, room: Path, frames: list[Frame], networks: dict[str, str]
) -> None:
    """The first one loads networks, index and keyframes; what the others spend outside of the work itself is little."""
    db = open_file(**networks)
    db.ingest(room, map="office", stride=STRIDE)
    fresh = open_file(**networks)
    walls, works = [], []
    for _ in range(6):
        started = time.perf_counter()
        answer = fresh.localize(replace(frames[6], instances=None))
        walls.append((time.perf_counter() - started) * 1000)
        works.append(sum(ms for part, ms in answer.timing_ms.items() if part not in ("total", "decode")))
    overhead = [wall - work for wall, work in zip(walls, works, strict=True)]
    assert overhead[0] > 2 * min(overhead[1:])
    assert min(overhead[1:]) < 25  # ms: the log of queries is a transaction on the disk
