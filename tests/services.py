"""A Redis of the tests' own, and workers as processes."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.rooms import environment


def free_port() -> int:
    """A port of the loopback interface that nobody listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def wait_until(condition: Callable[[], bool], what: str, seconds: float = 60.0) -> None:
    """Returns when `condition` holds; fails the test when it does not in time."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"in {seconds:g} s it did not come to this: {what}")
        time.sleep(0.02)


class Redis:
    """A Redis server that keeps nothing on disk."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.url = f"redis://127.0.0.1:{self.port}/0"
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        program = shutil.which("redis-server")
        if program is None:
            pytest.fail("no redis-server here: scripts/install-services.sh installs it", pytrace=False)
        arguments = ["--port", str(self.port), "--bind", "127.0.0.1", "--save", "", "--appendonly", "no"]
        self._process = subprocess.Popen(
            [program, *arguments, "--dir", str(self._folder)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wait_until(self.answers, "Redis answers")

    def answers(self) -> bool:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1) as connection:
            connection.sendall(b"PING\r\n")
            return connection.recv(7).startswith(b"+PONG")
        return False

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def redis(folder: Path) -> Iterator[Redis]:
    server = Redis(folder)
    server.start()
    try:
        yield server
    finally:
        server.kill()


@dataclass
class Worker:
    """A Celery worker: one process that starts and watches others, which do the work."""

    process: subprocess.Popen[bytes]
    log: Path

    def children(self) -> list[int]:
        """The processes that work."""
        found: list[int] = []
        for path in Path(f"/proc/{self.process.pid}/task").glob("*/children"):  # any of its threads may start one
            with contextlib.suppress(OSError):
                found += [int(pid) for pid in path.read_text().split()]
        return found

    def kill(self) -> None:
        """SIGKILL for all of its processes."""
        pids = [self.process.pid, *self.children()]
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()

    def text(self) -> str:
        return self.log.read_text(errors="replace")


def start_worker(folder: Path, database_url: str, broker_url: str, *, processes: int = 1, **settings: str) -> Worker:
    """A worker with so many processes; its log is in `folder`. Returns at once."""
    command = [sys.executable, "-m", "celery", "--app", "semdb.workers", "worker", "--concurrency", str(processes)]
    command += ["--loglevel", "info", "--without-gossip", "--without-mingle"]
    return start(command, folder, database_url, broker_url, **settings)


def start(command: Sequence[str], folder: Path, database_url: str, broker_url: str, **settings: str) -> Worker:
    """A worker that is run by `command`; its log is in `folder`. Returns at once."""
    log = folder / f"worker-{time.monotonic_ns()}.log"
    with log.open("wb") as file:
        process = subprocess.Popen(
            command,
            env=environment(database_url, SEMDB_BROKER_URL=broker_url, **settings),
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    return Worker(process, log)


@contextlib.contextmanager
def workers(*started: Worker) -> Iterator[list[Worker]]:
    """A list of workers, to which others may be added; all are killed in the end."""
    running = list(started)
    try:
        yield running
    finally:
        for worker in running:
            worker.kill()
