"""How `semdb localize` prints: the last line, trajectories without times, JSON that ends, colours."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semdb.cli.localized import Tally, Trajectory, trajectory_file
from semdb.cli.output import JsonList, painted, print_json
from semdb.door.values import Answer
from semdb.errors import UsageError
from semdb.geometry.tum import tum_line
from semdb.types import Verdict


def answer(verdict: Verdict = Verdict.LOCALIZED, index: int | None = None, time_ns: int | None = None) -> Answer:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, -2.0, 0.5
    return Answer(
        image="a.png",
        verdict=verdict,
        map="room",
        world_from_camera=None if verdict is Verdict.FAILED else pose,
        covariance=None,
        confidence=0.9,
        inliers=50,
        stage="filtered",
        reason="",
        objects=(),
        candidates=(),
        ranked_share=1.0,
        keyframes_matched=1,
        refinements={},
        timing_ms={},
        frame_index=index,
        timestamp_ns=time_ns,
    )


def test_lines_of_tum() -> None:
    pose = np.array([[0, -1, 0, 1.25], [1, 0, 0, -2], [0, 0, 1, 0], [0, 0, 0, 1]], float)
    expected = (
        "1305031102.175304001 1.250000000 -2.000000000 0.000000000 0.000000000 0.000000000 0.707106781 0.707106781"
    )
    assert tum_line(1305031102175304001, pose) == expected
    assert tum_line(7, pose).startswith("0.000000007 ")
    assert tum_line(-1_500_000_000, pose).startswith("-1.500000000 ")


def test_only_what_was_localized_is_in_a_trajectory() -> None:
    stream = io.StringIO()
    trajectory = Trajectory(stream)
    for number, verdict in enumerate(Verdict):
        trajectory.add(answer(verdict, number, 10**9 + number), number)
    rows = [line for line in stream.getvalue().splitlines() if not line.startswith("#")]
    assert [row.split()[0] for row in rows] == ["1.000000000"]
    assert trajectory.poses == 1


def test_without_times_the_number_is_the_time() -> None:
    stream = io.StringIO()
    trajectory = Trajectory(stream)
    trajectory.add(answer(index=160), 0)  # of a recording
    trajectory.add(answer(), 3)  # an image of a folder
    lines = stream.getvalue().splitlines()
    assert "the first column is their number, in seconds" in lines[1]
    assert [line.split()[0] for line in lines[3:]] == ["160.000000000", "3.000000000"]
    mixed = Trajectory(io.StringIO())
    mixed.add(answer(time_ns=5), 0)
    with pytest.raises(UsageError, match=r"a\.png has no time"):
        mixed.add(answer(), 1)


def test_a_trajectory_that_is_cut_off_replaces_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "t.txt"
    target.write_text("before")
    for poses in (0, 2):
        with pytest.raises(KeyboardInterrupt), trajectory_file(target) as trajectory:  # noqa: PT012
            assert trajectory is not None
            for number in range(poses):
                trajectory.add(answer(index=number), number)
            raise KeyboardInterrupt
        assert target.read_text() == "before"
        assert (tmp_path / "t.txt.part").exists() == bool(poses)
    assert "2 poses so far are in" in capsys.readouterr().err
    with trajectory_file(target) as trajectory:
        assert trajectory is not None
        trajectory.add(answer(index=7), 0)
    assert target.read_text().splitlines()[-1].startswith("7.000000000 1.0")
    assert [path.name for path in tmp_path.iterdir()] == ["t.txt"]


def test_the_last_line() -> None:
    tally = Tally()
    assert tally.line == "localized 0 of 0"
    tally.verdicts[Verdict.LOCALIZED] += 20
    assert tally.line == "localized 20 of 20"
    tally.verdicts[Verdict.AMBIGUOUS] += 3
    tally.verdicts[Verdict.FAILED] += 2
    tally.unread += 1
    assert tally.line == "localized 20 of 26 (3 ambiguous, 2 failed, 1 not read)"


@pytest.mark.parametrize("values", [[], [{"a": [1, 2], "b": {"c": "x\ny"}}], [1, {"é": None}, "text"]])
def test_a_list_that_comes_bit_by_bit_is_the_same_json(values: list[Any]) -> None:
    whole, parts = io.StringIO(), io.StringIO()
    print_json(values, whole)
    with JsonList(parts) as printed:
        for value in values:
            printed.add(value)
    assert parts.getvalue() == whole.getvalue()


def test_a_list_that_is_cut_off_is_json_all_the_same() -> None:
    stream = io.StringIO()
    with pytest.raises(ZeroDivisionError), JsonList(stream) as printed:  # noqa: PT012
        printed.add({"a": 1})
        raise ZeroDivisionError
    assert json.loads(stream.getvalue()) == [{"a": 1}]
    nothing = io.StringIO()
    with pytest.raises(ZeroDivisionError), JsonList(nothing):
        raise ZeroDivisionError
    assert nothing.getvalue() == ""


def test_no_colour_where_nobody_sees_it() -> None:
    assert painted("localized", "green") == "localized"  # stdout of a test is no terminal
