"""A program on a pseudo-terminal, as a person uses it."""

from __future__ import annotations

import contextlib
import os
import pty
import re
import select
import signal
import sys
import time
from pathlib import Path
from typing import Self

ESCAPES = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b[=>]")  # colours and cursor movements
LONGEST_WAIT_S = 60.0


class Terminal:
    """Runs `command` in the current folder, which is its home; a context manager that ends it."""

    def __init__(self, *command: str, **environment: str) -> None:
        variables = {
            "HOME": os.getcwd(),
            "PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin",
            "TERM": "xterm",
            "LANG": "C.UTF-8",
            **environment,
        }
        self.pid, self.terminal = pty.fork()
        if self.pid == 0:
            os.execvpe(command[0], list(command), variables)
        self.raw = ""
        self._waited = False
        self._gone = False  # the program

    @property
    def seen(self) -> str:
        """All that came, without colours and cursor movements."""
        return ESCAPES.sub("", self.raw)

    def type(self, text: str, until: str, again_s: float = LONGEST_WAIT_S) -> str:
        """Types and reads until `until` is seen; types it once more after `again_s`. Returns what came since."""
        before = len(self.seen)
        os.write(self.terminal, text.encode())
        deadline, again = time.monotonic() + LONGEST_WAIT_S, time.monotonic() + again_s
        while until not in self.seen[before:]:
            if time.monotonic() > again:
                os.write(self.terminal, text.encode())
                again = deadline
            found = self._read(min(deadline, again + 0.1) - time.monotonic())
            if not found and (self._gone or time.monotonic() >= deadline):
                raise AssertionError(f"{until!r} did not come: {self.seen[before:]!r}")
        return self.seen[before:]

    def end(self, text: str = "") -> int:
        """Types, reads to the end, and returns the exit code."""
        os.write(self.terminal, text.encode())
        while self._read(LONGEST_WAIT_S):
            pass
        _, status = os.waitpid(self.pid, 0)
        self._waited = True
        return os.waitstatus_to_exitcode(status)

    def _read(self, seconds: float) -> bool:
        if not select.select([self.terminal], [], [], max(0.0, seconds))[0]:
            return False
        try:
            data = os.read(self.terminal, 4096)
        except OSError:
            data = b""
        self._gone = not data
        self.raw += data.decode(errors="replace")
        return bool(data)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.terminal)
        if not self._waited:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, signal.SIGHUP)
            os.waitpid(self.pid, 0)
