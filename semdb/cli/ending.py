"""Commands that end when they are told to: soon, and in any case."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator

GRACE_S = 30.0


@contextlib.contextmanager
def ends_when_told(grace_s: float = GRACE_S) -> Iterator[None]:
    """Within, Ctrl-C raises KeyboardInterrupt and SIGTERM SystemExit(143), so that the command cleans up.

    An exception that comes at any moment may leave a lock held that a thread waits for; and a network may be busy for
    long. So `grace_s` seconds later the process is ended whatever it does: only for work that may be cut off anywhere.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    watchdogs: list[threading.Timer] = []

    def end(number: int, _frame: object) -> None:
        if not watchdogs:
            watchdogs.append(threading.Timer(grace_s, _leave, (128 + number,)))
            watchdogs[0].daemon = True
            watchdogs[0].start()
        if number == signal.SIGINT:
            raise KeyboardInterrupt
        print("semdb: terminated", file=sys.stderr)
        raise SystemExit(128 + number)

    ignored = signal.getsignal(signal.SIGINT) is signal.SIG_IGN  # as of a job in the background
    numbers = [signal.SIGTERM] if ignored else [signal.SIGTERM, signal.SIGINT]
    before = {number: signal.signal(number, end) for number in numbers}
    try:
        yield
    finally:
        for watchdog in watchdogs:
            watchdog.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave(code: int) -> None:
    os.write(2, b"semdb: did not end in time, so it was cut off; run the command again to go on\n")
    os._exit(code)
