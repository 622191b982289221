"""Stages that overlap: order, bounds, errors, leaving early."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Iterator

import pytest

from semdb.ingestion.pipeline import Stage, overlapped


def test_results_keep_the_order_whatever_the_times() -> None:
    chance = random.Random(3)
    waits = [chance.random() / 200 for _ in range(60)]
    written: list[int] = []

    def slow(number: int) -> int:
        time.sleep(waits[number])
        return number * 10

    def write(value: int) -> int:
        written.append(value)
        return value + 1

    stages = [Stage("slow", slow, 4), Stage("write", write)]
    assert list(overlapped(range(60), stages, window=8)) == [10 * k + 1 for k in range(60)]
    assert written == [10 * k for k in range(60)]


def test_no_more_than_the_window_is_under_way() -> None:
    lock = threading.Lock()
    inside, most = 0, 0

    def items() -> Iterator[int]:
        nonlocal inside, most
        for number in range(200):
            with lock:
                inside += 1
                most = max(most, inside)
            yield number

    def leave(number: int) -> int:
        nonlocal inside
        with lock:
            inside -= 1
        return number

    assert list(overlapped(items(), [Stage("a", lambda n: n, 3), Stage("b", leave)], window=5)) == list(range(200))
    assert most <= 5


def test_stages_overlap() -> None:
    """Two stages that wait for each other's next item would never end if they took turns."""
    meet = threading.Barrier(2, timeout=10)

    def first(number: int) -> int:
        if number > 0:
            meet.wait()
        return number

    def second(number: int) -> int:
        if number < 3:
            meet.wait()
        return number

    assert list(overlapped(range(4), [Stage("first", first), Stage("second", second)], window=4)) == [0, 1, 2, 3]


def test_the_first_error_ends_all() -> None:
    written: list[int] = []

    def fail_at_five(number: int) -> int:
        if number == 5:
            raise ValueError("five")
        return number

    def write(number: int) -> int:
        written.append(number)
        return number

    before = threading.active_count()
    with pytest.raises(ValueError, match="five"):
        list(overlapped(range(1000), [Stage("a", fail_at_five), Stage("b", write)], window=6))
    assert written == sorted(written)
    assert set(written) <= {0, 1, 2, 3, 4}
    assert threading.active_count() == before


def test_leaving_early_ends_the_threads_and_drops_the_rest() -> None:
    done: list[int] = []
    results = overlapped(range(1000), [Stage("a", lambda n: done.append(n) or n, 2)], window=4)
    assert next(results) == 0
    before = len(done)
    results.close()  # type: ignore[attr-defined]
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("semdb-a")]
    assert len(done) <= before + 4
