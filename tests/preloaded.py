"""Commands in processes of their own that need not import everything anew: a server that has, and forks.

A command spends a second of processor time on imports, and the tests run hundreds. What is left out is what happens
before `main`: tests of that (memory, byte code, settings of the interpreter, signals) start real ones.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests import compiling

REPOSITORY = Path(__file__).resolve().parent.parent
MODULES = (
    "semdb.cli.main",
    "semdb.api",
    "semdb.recordings",
    "semdb.recordings.synthetic",
    "semdb.ingestion.run",
    "semdb.localization.open_maps",
    "semdb.evaluation",
    "semdb.refinement",
    "scipy.stats",
    "matplotlib.figure",
)
_server: Server | None = None
_starting = threading.Lock()


def run(
    arguments: Sequence[str], environment: Mapping[str, str], cwd: Path | None, timeout_s: float
) -> subprocess.CompletedProcess[str]:
    """As ``subprocess.run([python, "-m", "semdb.cli.main", *arguments])`` with its output as text."""
    global _server  # noqa: PLW0603
    with _starting:
        if _server is None:
            _server = Server()
    return _server.run(arguments, environment, cwd, timeout_s)


class Server:
    """The process that forks. It ends with this one."""

    def __init__(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.preloaded", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                cwd=REPOSITORY,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        self._socket = ours
        self._asking = threading.Lock()

    def run(
        self, arguments: Sequence[str], environment: Mapping[str, str], cwd: Path | None, timeout_s: float
    ) -> subprocess.CompletedProcess[str]:
        request = {"arguments": list(arguments), "environment": dict(environment), "cwd": str(cwd or Path.cwd())}
        text = json.dumps(request).encode()
        with (
            open(os.devnull, "rb") as nothing,
            tempfile.TemporaryFile() as out,
            tempfile.TemporaryFile() as err,
            contextlib.ExitStack() as stack,
        ):
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
            stack.enter_context(ours)
            with theirs, self._asking:
                files = [nothing.fileno(), out.fileno(), err.fileno(), theirs.fileno()]
                socket.send_fds(self._socket, [struct.pack("<I", len(text))], files)
                self._socket.sendall(text)
            code = _wait(ours, [*map(str, arguments)], timeout_s)
            streams = [_text(stream) for stream in (out, err)]
        return subprocess.CompletedProcess([*map(str, arguments)], code, *streams)


def _wait(answers: socket.socket, command: list[str], timeout_s: float) -> int:
    """The exit code that `answers` brings, after the number of the process."""
    answers.settimeout(timeout_s)
    pid = 0
    try:
        pid = _number(answers)
        return _number(answers)
    except TimeoutError:
        if pid:
            os.kill(pid, signal.SIGKILL)
        raise subprocess.TimeoutExpired(command, timeout_s) from None


def _text(stream: Any) -> str:
    stream.seek(0)
    return str(stream.read().decode()).replace("\r\n", "\n")


def _number(source: socket.socket) -> int:
    return int(struct.unpack("<i", _exactly(source, 4))[0])


def _exactly(source: socket.socket, size: int) -> bytes:
    read = b""
    while len(read) < size:
        part = source.recv(size - len(read))
        if not part:
            raise EOFError("the process that runs commands for the tests has ended")
        read += part
    return read


def _serve(requests: socket.socket) -> dict[str, Any] | None:
    """Forks for every request; returns the request in the process that is to answer it, and None in the end."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while True:
        head, files, _, _ = socket.recv_fds(requests, 4, 4)
        if not head:
            return None
        request = json.loads(_exactly(requests, int(struct.unpack("<I", head)[0])))
        if os.fork() == 0:  # one that waits, so that this one need not
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            requests.close()
            pid = os.fork()
            if pid == 0:
                _become(request, files)
                return request  # type: ignore[no-any-return]
            answers = socket.socket(fileno=files[3])
            answers.sendall(struct.pack("<i", pid))
            answers.sendall(struct.pack("<i", os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])))
            os._exit(0)
        for file in files:
            os.close(file)


def _become(request: Mapping[str, Any], files: Sequence[int]) -> None:
    for number, file in enumerate(files[:3]):
        os.dup2(file, number)
    for file in files:
        os.close(file)
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["environment"])
    time.tzset()


def _main() -> None:
    requests = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    compiling.one_at_a_time()
    main = importlib.import_module("semdb.cli.main")
    for module in MODULES:
        importlib.import_module(module)
    gc.freeze()  # or every process would copy all of it as its collector looks through
    request = _serve(requests)
    if request is not None:
        sys.argv = [str(main.__file__), *request["arguments"]]
        main.main()


if __name__ == "__main__":
    _main()
