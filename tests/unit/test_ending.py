"""A command that is told to end does, even where a thread never would."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import pytest

from semdb.cli.ending import ends_when_told

STUCK = """
import threading
from semdb.cli.ending import ends_when_told
with ends_when_told(0.5):
    try:
        print("ready", flush=True)
        threading.Event().wait(60)
    finally:
        threading.Event().wait(60)  # a lock that nobody gives back
"""


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_what_is_stuck_is_cut_off(sent: signal.Signals, code: int) -> None:
    process = subprocess.Popen([sys.executable, "-c", STUCK], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(sent)
    _, said = process.communicate(timeout=30)
    assert process.returncode == code
    assert "run the command again" in said


def send(number: signal.Signals) -> None:
    os.kill(os.getpid(), number)
    threading.Event().wait(5)


def test_it_raises_at_once_and_leaves_signals_as_they_were() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), ends_when_told():
        send(signal.SIGINT)
    with pytest.raises(SystemExit, match="143"), ends_when_told():
        send(signal.SIGTERM)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
