"""Progress on stderr: a bar with rate and time left on a terminal, a plain line every few seconds otherwise."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self, TextIO

from semdb.shown import for_terminal, measure

SECONDS_BETWEEN_LINES = 5.0
OF_TRAJECTORIES = {"closing loops": "pairs", "bundle adjustment": "rounds"}  # what is counted, where it is not frames
LEAST_FOR_TIME_LEFT = 3  # so many after the first one; they may be steps of minutes, so not more


def format_duration(seconds: float) -> str:
    """``75.2`` becomes ``1:15``, ``3700`` becomes ``1:01:40``."""
    minutes, rest = divmod(round(max(seconds, 0.0)), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


class Progress:
    """Context manager whose `update` is the callback ``(done, total)`` that long functions take."""

    def __init__(
        self, label: str, unit: str = "frames", *, stream: TextIO | None = None, terminal: bool | None = None
    ) -> None:
        self.label, self.unit = for_terminal(label), unit
        self.stream = stream or sys.stderr
        self.terminal = self.stream.isatty() if terminal is None else terminal
        self.started = self.printed = time.monotonic()
        self._before: int | None = None  # what was done before, by a run or a download that goes on
        self._first: tuple[int, float] | None = None  # what the first call said was done, and when
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> Self:
        self.started = self.printed = time.monotonic()
        if self.terminal:
            self._bar = _rich_bar(self.stream)
            self._bar.start()
            self._task = self._bar.add_task(self.label, total=None, unit=self.unit, rate="")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def go_on(self, done: int, total: int) -> None:
        """As `update`, of work that may go on from before: the first call says from where, which is not speed."""
        if self._before is None:
            self._before = done
        self.update(done, total)

    def update(self, done: int, total: int) -> None:
        """Say that `done` of `total` are finished. Cheap: may be called for every frame."""
        now = time.monotonic()
        if self._first is None:
            self._first = (done, now)
        rate = (done - (self._before or 0)) / max(now - self.started, 1e-9)
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total, rate=f"{measure(rate, 1)} {self.unit}/s")
        elif now - self.printed >= SECONDS_BETWEEN_LINES:
            self.printed = now
            line = f"{self.label}: {done} of {total} {self.unit}, {measure(rate, 1)}/s{self._left(done, total, now)}"
            print(line, file=self.stream, flush=True)

    def _left(self, done: int, total: int, now: float) -> str:
        """The time left; nothing yet after the first one, which waits for networks and kernels."""
        first, at = self._first or (done, now)
        if done < total and done - first < LEAST_FOR_TIME_LEFT:
            return ""
        return f", {format_duration((total - done) * (now - at) / max(done - first, 1))} left"


def _rich_bar(stream: TextIO) -> Any:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    return RichProgress(
        TextColumn("{task.description}", markup=False),  # a name may hold [brackets]
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}", markup=False),
        TextColumn("{task.fields[rate]}", markup=False),
        TimeRemainingColumn(),
        console=Console(file=stream),
        transient=True,
    )


class StagedProgress:
    """Progress of work in several stages: a bar for each stage that is named, one after the other.

    `units` says by stage what is counted, where it is not the `usual`.
    """

    def __init__(self, units: Mapping[str, str] | None = None, usual: str = "frames") -> None:
        self._label = ""
        self._units, self._usual = dict(units or {}), usual
        self._current: Progress | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def _end(self) -> None:
        if self._current is not None:
            self._current.__exit__(None, None, None)
            self._current = None

    def update(self, label: str, done: int, total: int) -> None:
        """Say that `done` of `total` of the stage `label` are finished."""
        if label != self._label or self._current is None:
            self._end()
            self._label = label
            self._current = Progress(label, self._units.get(label, self._usual)).__enter__()
        self._current.update(done, total)


def say(line: str) -> None:
    """A line for people, on stderr; one line whatever names it holds."""
    print(f"semdb: {for_terminal(line)}", file=sys.stderr, flush=True)
