"""Every command that shows names, on a database, and on results, whose names are escape sequences, markup, mathematics.

The database is shared: rows need not have been written by semdb, which refuses most of these names itself.
"""

from __future__ import annotations

import io
import json
import os
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console
from sqlalchemy import create_engine, text
from typer.testing import CliRunner

from semdb.cli.evaluate import Outputs
from semdb.cli.main import app
from semdb.database.store import open_store
from semdb.errors import RecordingError
from semdb.evaluation.confidence_plots import answers, confidence_plot
from semdb.evaluation.plots import cumulative_plot, figure_png, inlier_plot, series_names, timing_plot, trajectory_plot
from semdb.evaluation.report import write_report
from semdb.evaluation.runner import Outcome
from semdb.evaluation.tables import grid_markdown, results_markdown, retrieval_grid, rich_table, terminal_tables
from semdb.evaluation.trajectories import write_trajectories
from semdb.pictures.drawing import draw_localization
from semdb.pictures.top_view import MapObject, draw_top_view
from semdb.recordings import Recording
from semdb.shown import for_html, for_terminal
from semdb.types import Detection, Verdict
from tests.database_samples import fill
from tests.unit.test_evaluation_plots import EMPTY, result

HOSTILE = "\x1b[31m\x9b2J $\\frac{x$ [red]r[/red] [/] :smile: <b>\n&\"'\u202e _%s"
NAMES = [
    HOSTILE,
    "厨" * 255,
    "$\\frac{x$",
    "[/]",
    "$a$ $b$",
    "_x",
    "\n\nsemdb: forged",
    "\x1b]0;t\x07",
    "厨房",
    "<script>alert(1)",
]


@pytest.fixture(autouse=True)
def _empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in os.environ if name.startswith("SEMDB_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("SEMDB_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def hostile_database() -> None:
    """Every text in it that is not a key of something is hostile."""
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        _, recording_id, _ = fill(store)
        fill(store, name="second", frame_indexes=(1, 2), seed=50)
        assert recording_id == 1
    engine = create_engine("sqlite:///semdb.sqlite3")
    with engine.begin() as connection:
        for statement in (
            "UPDATE maps SET name = :x",
            "UPDATE recordings SET name = :x || id, source = '/data/' || :x, format = substr(:x, 1, 32)",
            "UPDATE categories SET name = :x || id",
            "UPDATE models SET name = :x, config = json_object('x', :x)",
            "UPDATE ingest_items SET state = 'failed', error = :x WHERE recording_id = 1 AND frame_index = 3",
        ):
            connection.execute(text(statement), {"x": HOSTILE})
    engine.dispose()


def lines(*arguments: str, code: int = 0) -> list[str]:
    """The lines that a command prints, each printable."""
    done = CliRunner().invoke(app, list(arguments))
    assert done.exit_code == code, f"{done.exit_code}: {done.output!r} {done.exception!r}"
    found = [*done.stdout.split("\n"), *done.stderr.split("\n")]
    assert all(line.isprintable() for line in found), found
    return found


SHOWN = for_terminal(HOSTILE)


@pytest.mark.usefixtures("hostile_database")
def test_commands_on_rows_with_hostile_names() -> None:
    table = lines("status")
    assert sum(SHOWN in line for line in table) == 3  # two recordings, one failed keyframe
    assert f"failed: {SHOWN}1 frame 3, attempt 1: {SHOWN}" in table
    assert json.loads(CliRunner().invoke(app, ["status", "--json"]).stdout)[0]["map"] == HOSTILE
    (put_back,) = (line for line in lines("retry") if SHOWN in line)
    assert put_back.startswith(f"{SHOWN}/{SHOWN}1: 1 put back; run: semdb ingest $'/data/\\x1b[31m")
    assert any(SHOWN in line for line in lines("models", "list"))
    assert sum(SHOWN in line for line in lines("keypoints", "1")) > 3
    done = [line for line in lines("refine") if line and not line.startswith("semdb: what is damaged of keyframe ")]
    assert [line for line in done if not line.startswith(f"{SHOWN}: ")] == []
    assert "there is no map" in lines("delete", "map", HOSTILE + "?", "--yes", code=1)[1]
    assert lines("delete", "recording", HOSTILE + "2", "--yes")[0].startswith(f"deleted the recording {SHOWN}/{SHOWN}2")
    assert lines("delete", "map", HOSTILE, "--yes")[0].startswith(f"deleted the map {SHOWN}")


@pytest.mark.usefixtures("hostile_database")
def test_a_question_on_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    monkeypatch.setattr("sys.stdin", type("Terminal", (io.StringIO,), {"isatty": lambda _self: True})())
    monkeypatch.setattr("typer.confirm", lambda question, err: asked.append(question) or True)
    from semdb.cli.delete import confirm

    confirm(f"Delete the map {HOSTILE}?", yes=False)
    assert asked == [f"Delete the map {SHOWN}?"]


@pytest.mark.usefixtures("hostile_database")
@pytest.mark.parametrize("fmt", ["table", "json", "csv"])
def test_sql_of_hostile_values_and_columns(fmt: str) -> None:
    statement = f'SELECT name AS "{HOSTILE.replace(chr(34), "")}", name AS n FROM recordings'
    done = CliRunner().invoke(app, ["sql", statement, "--format", fmt])
    assert done.exit_code == 0
    if fmt == "csv":  # a pipe gets what is stored
        assert HOSTILE.replace('"', '""') in done.stdout
        return
    assert all(line.isprintable() for line in done.stdout.split("\n"))
    if fmt == "json":
        assert [row["n"] for row in json.loads(done.stdout)] == [f"{HOSTILE}1", f"{HOSTILE}2"]
    else:
        assert len(done.stdout.split("\n")) == 5


@pytest.mark.parametrize(
    "arguments",
    [
        ["status", HOSTILE],
        ["keypoints", HOSTILE],
        [HOSTILE],
        [f"--{HOSTILE}"],
        ["recording", f"--{HOSTILE}"],
        ["models", "pull", HOSTILE],
        ["synth", "x", "--frames", HOSTILE],
        ["delete", HOSTILE],
        ["status", "--database-url", f"sqlite:///{HOSTILE}"],
        ["status", "--database-url", HOSTILE],
        ["recording", HOSTILE],
        ["ingest", HOSTILE, "--name", HOSTILE],
        ["ingest", HOSTILE, "--camera", HOSTILE],
        ["localize", HOSTILE, "--detector", HOSTILE],
        ["sql", HOSTILE],
        ["doctor", "--device", HOSTILE],
        ["evaluate", HOSTILE, "--keyframes", HOSTILE],
    ],
)
def test_errors_that_repeat_what_was_typed(arguments: list[str]) -> None:
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code in (1, 2)
    assert not isinstance(done.exception, SystemExit) or done.exception.code in (1, 2)
    assert all(line.isprintable() for line in (done.stdout + done.stderr).split("\n")), done.stderr


def test_what_a_recording_is_said_to_hold(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / HOSTILE.replace("/", "|")
    folder.mkdir()
    for entry in room.iterdir():
        if entry.name != "rgb.txt":
            (folder / entry.name).symlink_to(entry)
    rows = (room / "rgb.txt").read_text().splitlines()
    rows[4] = rows[4].split()[0] + " rgb/\x1b[2J$x$.png"
    (folder / "rgb.txt").write_text("\n".join(rows) + "\n")
    found = lines("recording", "--quick", str(folder))
    assert found[0].startswith(f"recording    {for_terminal(folder.name)} (synthetic) in ")
    assert any(r"rgb/\x1b[2J$x$.png" in line for line in found)
    monkeypatch.setattr(Recording, "trajectory_length", lambda _self: 0.0042)
    assert any(line == "trajectory   0.004 m" for line in lines("recording", "--quick", str(folder)))


def _renamed(name: str) -> list:  # type: ignore[type-arg]
    first = result(recording=name)
    queries = tuple(replace(q, frame=f"rgb/{name}.png", reason=name, recording=name) for q in first.per_query)
    second = replace(result("cnn", recording=f"{name}2"), per_query=queries)
    return [replace(first, per_query=queries), second, replace(EMPTY, recording=name), result("paper", recording=name)]


@pytest.mark.parametrize("name", NAMES)
def test_tables_of_an_evaluation(name: str) -> None:
    for results in (_renamed(name), _renamed(name)[:2]):
        for table in terminal_tables(results, ablation=True):
            for terminal in (False, True):
                stream = io.StringIO()
                Console(width=2000, file=stream, force_terminal=terminal, no_color=True).print(table)
                shown = re.sub(r"\x1b\[[0-9;]*m", "", stream.getvalue())  # its own: bold, and back
                assert all(line.isprintable() for line in shown.split("\n"))
        stream = io.StringIO()
        Console(width=2000, file=stream).print(*terminal_tables(results))
        whole = "".join(stream.getvalue().split())  # a long title is folded
        assert "".join(for_terminal(name).split()) in whole
        text_of = results_markdown(results)
        assert len(text_of.split("\n")) == len(results) + 3
        assert "\n" not in grid_markdown(retrieval_grid(results)).split("\n", 3)[2]
    assert rich_table(retrieval_grid(_renamed(name))).title is not None


def _figures(results: list) -> Iterator[object]:  # type: ignore[type-arg]
    yield cumulative_plot(results)
    yield timing_plot(results)
    series = zip(series_names(results), results, strict=True)
    yield confidence_plot([(name, *answers(one)) for name, one in series])
    for one in results[:2]:
        yield trajectory_plot(one)
        yield inlier_plot(one)


def test_plots_of_an_evaluation() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for figure in _figures([result(recording=name) for name in NAMES]):
            figure_png(figure)  # type: ignore[arg-type]
    figure = cumulative_plot(_renamed("_x"))
    assert len(figure.legends[0].get_texts()) == 4  # a label that begins with an underscore is in it


def test_equal_names_have_a_bar_each() -> None:
    figure = timing_plot([result(), result()])
    assert figure is not None
    assert len(figure.axes[0].get_yticklabels()) == 2


def test_a_report_with_hostile_names(tmp_path: Path) -> None:
    results = [*_renamed(HOSTILE)[:1], result(recording="<script>alert(1)"), result(recording="$a$ $b$")]
    one_each = [replace(one, per_query=one.per_query[-3:]) for one in results]
    names = {name: name for name in NAMES}
    written = write_report(tmp_path / "report", one_each, settings=names, failures=names)
    text_of = written.read_text(encoding="utf-8")
    assert all(c.isprintable() or c == "\n" for c in text_of)
    assert all(text_of.count(for_html(name)) >= 4 for name in NAMES)
    for tag in ("<script", "<b>\n", "[red]<"):
        assert tag not in text_of
    assert len(json.loads((tmp_path / "report" / "results.json").read_text())) == 3


def test_what_cannot_be_evaluated_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = Outputs(None, tmp_path / "report", None, {}, several=True)
    output.add(Outcome(HOSTILE, error=RecordingError(f"{HOSTILE}: is none")))
    shown = capsys.readouterr().err
    assert shown == f"semdb: not evaluated: {for_terminal(HOSTILE)}: is none\n"


def test_trajectories_of_names_that_become_the_same_file(tmp_path: Path) -> None:
    results = [
        replace(one, per_query=tuple(replace(query, recording="") for query in one.per_query))
        for one in (result(recording=name) for name in ("a b", "a_b", "/../\n", "厨" * 255))
    ]
    written = write_trajectories(tmp_path, results)
    assert len({path.name for path in written}) == len(list(tmp_path.iterdir())) == 8
    assert {path.name for path in written} >= {"a_b-semdb-25.txt", "a_b-semdb-25-2.txt"}
    assert max(len(path.name.encode()) for path in written) <= 255


@pytest.mark.parametrize("name", [HOSTILE, "$\\frac{x$", "厨房" * 100, "\ud800"])
def test_pictures_of_a_localization(name: str) -> None:
    image = np.zeros((48, 64, 3), np.uint8)
    mask = np.zeros((48, 64), np.bool_)
    mask[10:20, 10:20] = True
    things = [Detection(name, 0.9, np.array([10, 10, 20, 20], np.float32), mask)]
    xy = np.array([[12.0, 12.0]], np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drawn = draw_localization(
            image, things, image, things, xy, xy, title=name, verdict=Verdict.LOCALIZED, facts=[(name, name)] * 2,
            query_label=name, keyframe_label=name,
        )  # fmt: skip
        above = draw_top_view(np.eye(4)[None], objects=[MapObject(name, np.array([0.0, 0.0, 1.0]))], title=name)
    assert drawn.shape[2] == above.shape[2] == 3


def test_names_are_drawn_as_they_are() -> None:
    """Dollar signs are drawn, not read: the pixels are those of the same characters drawn one by one as text."""
    image = np.zeros((48, 64, 3), np.uint8)
    drawn = [
        draw_localization(image, [], None, [], title=title, verdict=Verdict.FAILED) for title in ("$a$", "$b$", "a")
    ]
    assert not np.array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
