"""Answers of `semdb localize` as people, programs and evo get them."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from semdb.cli.output import SIGMA_NOTE, print_lines, print_painted
from semdb.cli.progress import say
from semdb.door.values import Answer
from semdb.errors import UsageError
from semdb.geometry.tum import TUM_COLUMNS, tum_line
from semdb.shown import measure
from semdb.types import FloatArray, Verdict

COLOURS = {Verdict.LOCALIZED: "green", Verdict.AMBIGUOUS: "yellow", Verdict.COARSE: "magenta", Verdict.FAILED: "red"}


def print_answer(answer: Answer) -> None:
    """One image in several lines."""
    confidence = measure(answer.confidence, 2, unless=(0.0, 1.0))
    print_lines(answer.image)
    print_verdict("  verdict     ", answer.verdict, f" (confidence {confidence}): {answer.reason}")
    if answer.position is not None and answer.quat_wxyz is not None:
        position = " ".join(f"{value:.4f}" for value in answer.position)
        quaternion = " ".join(f"{value:.5f}" for value in answer.quat_wxyz)
        print_lines(f"  position    {position} m in map {answer.map}", f"  quat_wxyz   {quaternion}")
        if answer.covariance is not None:
            sigmas = f"position {measure(1000 * answer.sigma_m, 1)} mm, rotation {measure(answer.sigma_deg, 2)} deg"
            print_lines(f"  sigma       {sigmas} ({SIGMA_NOTE})")
    named = [f"{c.recording}/{c.frame_index} ({c.inliers})" for c in answer.candidates]
    spent = ", ".join(f"{stage} {value:.0f}" for stage, value in answer.timing_ms.items())
    print_lines(
        f"  candidates  {', '.join(named) or 'none'} (inliers), stage {answer.stage}",
        f"  ms          {spent}",
    )


def print_verdict(before: str, verdict: Verdict, after: str) -> None:
    """A line with the verdict in its colour."""
    print_painted(before, str(verdict), after, colour=COLOURS[verdict])


class AnswerTable:
    """Many images of one place with a line each, under a head that says what the numbers are."""

    HEAD = f"{'x':>8} {'y':>8} {'z':>8} m  {'sigma':>18}  {'inliers':>7} {'ms':>6}"

    def __init__(self, where: str, labels: str, width: int) -> None:
        """`where` the images are, what their `labels` are called, and how wide those are at most."""
        self._where, self._labels, self._width = where, labels, max(width, len(labels))
        self._map: str | None = None

    def add(self, answer: Answer, label: str) -> None:
        """Prints the line of an answer; another map than that of the first is named."""
        if self._map is None:
            self._map = answer.map
            print_lines(
                f"{self._where} in map {answer.map}; sigma is {SIGMA_NOTE}",
                f"  {self._labels:>{self._width}}  verdict    confidence  {self.HEAD}",
            )
        confidence = measure(answer.confidence, 2, unless=(0.0, 1.0))
        after = f"{'':{9 - len(answer.verdict)}}  {confidence:>10}  {self._numbers(answer)}"
        elsewhere = "" if answer.map == self._map else f"  in map {answer.map}"
        print_verdict(f"  {label:>{self._width}}  ", answer.verdict, after + elsewhere)

    @staticmethod
    def _numbers(answer: Answer) -> str:
        if answer.position is None:
            return answer.reason
        sigma = ""
        if answer.covariance is not None:
            sigma = f"{measure(1000 * answer.sigma_m, 1)} mm {measure(answer.sigma_deg, 2)} deg"
        x, y, z = answer.position
        spent = answer.timing_ms.get("total", 0.0)
        return f"{x:8.3f} {y:8.3f} {z:8.3f} m  {sigma:>18}  {answer.inliers:>7} {spent:6.0f}"


class Tally:
    """Counts the verdicts for the last line."""

    def __init__(self) -> None:
        self.verdicts: Counter[Verdict] = Counter()
        self.unread = 0

    @property
    def asked(self) -> int:
        """How many images there were so far."""
        return self.verdicts.total() + self.unread

    @property
    def line(self) -> str:
        """``localized 20 of 24 (3 ambiguous, 1 not read)``."""
        others = [(self.verdicts[verdict], str(verdict)) for verdict in Verdict if verdict is not Verdict.LOCALIZED]
        parts = [f"{count} {name}" for count, name in (*others, (self.unread, "not read")) if count]
        found = f"localized {self.verdicts[Verdict.LOCALIZED]} of {self.asked}"
        return f"{found} ({', '.join(parts)})" if parts else found


class Trajectory:
    """Poses of localized images in TUM's format, written as they come.

    Times are those of the recording; where it has none, the number of the frame, or of the image, in seconds (said in
    the file). The first answer decides which.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._timed: bool | None = None
        self.poses = 0

    def add(self, answer: Answer, number: int) -> None:
        """Writes the pose, if it was localized. Raises UsageError for an image without a time among others with one."""
        if self._timed is None:
            self._timed = answer.timestamp_ns is not None
            lines = ["# poses of localized images, world from camera, metres"]
            if not self._timed:
                lines.append("# the images have no times: the first column is their number, in seconds")
            self._stream.write("\n".join([*lines, TUM_COLUMNS]) + "\n")
        if self._timed and answer.timestamp_ns is None:
            raise UsageError(f"--trajectory: {answer.image} has no time, but images before it do")
        if answer.localized and answer.world_from_camera is not None:
            index = number if answer.frame_index is None else answer.frame_index
            time_ns = answer.timestamp_ns if self._timed and answer.timestamp_ns is not None else index * 10**9
            self.write(time_ns, answer.world_from_camera)

    def write(self, time_ns: int, world_from_camera: FloatArray) -> None:
        """Writes a pose ``[4, 4]``."""
        if self._timed is None:
            self._timed = True
            self._stream.write(f"# poses of tracked frames, world from camera, metres\n{TUM_COLUMNS}\n")
        self._stream.write(tum_line(time_ns, world_from_camera) + "\n")
        self._stream.flush()
        self.poses += 1


@contextmanager
def trajectory_file(path: Path | None) -> Iterator[Trajectory | None]:
    """The trajectory at `path`, which is there when all went well; else what there is so far is in ``NAME.part``."""
    if path is None:
        yield None
        return
    part = path.with_name(f"{path.name}.part")
    with part.open("w", encoding="utf-8") as stream:
        trajectory = Trajectory(stream)
        try:
            yield trajectory
        except BaseException:
            if trajectory.poses:
                say(f"{trajectory.poses} poses so far are in {part}")
            else:
                part.unlink()
            raise
    os.replace(part, path)
    say(f"wrote {trajectory.poses} poses to {path}")


def prints_to_people() -> bool:
    """Whether what is printed is seen as it comes, so that it is progress enough."""
    return sys.stdout.isatty()
