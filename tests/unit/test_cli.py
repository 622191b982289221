"""The base of the command line: commands by name, errors in one line, settings as options, tables, progress."""

from __future__ import annotations

import csv
import io
import json
import os
import subprocess
import sys
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from semdb.cli import main as cli
from semdb.cli.options import Overrides, load_settings, settings_options
from semdb.cli.output import cell_text, print_rows
from semdb.cli.progress import Progress, format_duration
from semdb.errors import RecordingError, UsageError
from semdb.jsonable import to_jsonable

HEAVY = {"numba", "cv2", "scipy", "onnxruntime", "sqlalchemy", "matplotlib", "alembic", "pydantic", "numpy", "celery"}


@pytest.fixture(autouse=True)
def _no_settings(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in os.environ if name.startswith("SEMDB_")]:
        monkeypatch.delenv(name)


def invoke(*arguments: str) -> Any:
    return CliRunner().invoke(cli.app, list(arguments))


def raising(error: BaseException) -> Any:
    def command() -> None:
        raise error

    single = typer.Typer(rich_markup_mode=None)
    single.command("broken")(command)
    return typer.main.get_command(single)


# commands


@pytest.mark.parametrize("name", list(cli.COMMANDS))
def test_every_registered_command_has_help(name: str) -> None:
    result = invoke(name, "--help")
    assert result.exit_code == 0, result.output
    assert f"semdb {name}" in result.output or f"{name} [OPTIONS]" in result.output


def test_the_help_lists_every_command() -> None:
    result = invoke("--help")
    assert result.exit_code == 0
    listed = [line.split()[0] for line in result.output.partition("Commands:")[2].splitlines() if line.strip()]
    assert [name for name in listed if name in cli.COMMANDS] == list(cli.COMMANDS)


def test_the_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from semdb.cli.main import app\n"
        "try: app(['--help'], prog_name='semdb')\n"
        "except SystemExit: print('MODULES', *{name.split('.')[0] for name in sys.modules})"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    modules = set(result.stdout.rpartition("MODULES")[2].split())
    assert "semdb" in modules
    assert not modules & HEAVY


def test_version() -> None:
    import semdb

    result = invoke("--version")
    assert result.exit_code == 0
    assert result.output == f"semdb {semdb.__version__}\n"


def test_usage_errors_exit_with_2_and_suggest() -> None:
    result = invoke("recordin", "x")
    assert result.exit_code == 2
    assert "Did you mean 'recording'" in result.output
    assert invoke("recording").exit_code == 2
    assert invoke("recording", "x", "--no-such-option").exit_code == 2


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (RecordingError("rgb.txt: line 3: no number"), 1, "semdb: rgb.txt: line 3: no number\n"),
        (UsageError("--camera takes four numbers"), 2, "semdb: --camera takes four numbers\n"),
        (PermissionError(13, "Permission denied", "out.json"), 1, "semdb: out.json: Permission denied\n"),
        (KeyboardInterrupt(), 130, "semdb: interrupted\n"),
    ],
)
def test_errors_are_one_line_and_an_exit_code(
    monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, message: str
) -> None:
    monkeypatch.setattr(cli, "load_command", lambda _name: raising(error))
    result = invoke("doctor")
    assert result.exit_code == code
    assert result.stderr == message
    assert result.stdout == ""


def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMDB_DEBUG", "1")
    monkeypatch.setattr(cli, "load_command", lambda _name: raising(RecordingError("broken")))
    result = invoke("doctor")
    assert result.exit_code == 1
    assert "Traceback" in result.stderr
    assert result.stderr.endswith("semdb: broken\n")


def test_a_bug_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "load_command", lambda _name: raising(ZeroDivisionError("a bug")))
    result = invoke("doctor")
    assert isinstance(result.exception, ZeroDivisionError)


# settings


def test_options_override_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMDB_DATABASE_URL", "sqlite:///a.sqlite3")
    monkeypatch.setenv("SEMDB_ENCODER", "gist")
    settings = Overrides(database_url="sqlite:///b.sqlite3").settings()
    assert settings.database_url == "sqlite:///b.sqlite3"
    assert settings.encoder == "gist"
    assert Overrides().settings().database_url == "sqlite:///a.sqlite3"


def test_a_bad_setting_names_its_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMDB_THREADS", "many")
    with pytest.raises(UsageError, match=r"^SEMDB_THREADS=many: .*integer"):
        load_settings()
    monkeypatch.setenv("SEMDB_THREADS", "1")
    with pytest.raises(UsageError, match=r"^--score-threshold=2\.0: .*less than or equal to 1"):
        load_settings(score_threshold=2.0)


def test_settings_options_become_options() -> None:
    seen: list[tuple[Overrides, int]] = []

    @settings_options(models=True)
    def command(overrides: Overrides, number: Annotated[int, typer.Argument()], flag: bool = False) -> None:
        seen.append((overrides, number + flag))

    app = typer.Typer(rich_markup_mode=None)
    app.command()(command)
    arguments = ["4", "--flag", "--database-url", "sqlite:///x", "--detector", "recorded", "--device", "cuda"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.output
    assert seen == [(Overrides("sqlite:///x", "recorded", None, None, "cuda"), 5)]

    @settings_options(models=False)
    def light(overrides: Overrides) -> None: ...

    app = typer.Typer(rich_markup_mode=None)
    app.command()(light)
    assert CliRunner().invoke(app, ["--detector", "recorded"]).exit_code == 2


# output


ROWS = [(1, "cup", 0.5, None, b"abc"), (12, "dining table", float("nan"), 3, b"")]
COLUMNS = ("id", "name", "score", "count", "mask")


def printed(fmt: str) -> str:
    stream = io.StringIO()
    print_rows(COLUMNS, ROWS, fmt, stream)
    return stream.getvalue()


def test_table() -> None:
    assert printed("table").splitlines() == [
        "id  name          score  count  mask",
        "--  ------------  -----  -----  -------------",
        " 1  cup             0.5         blob, 3 bytes",
        "12  dining table    nan      3  blob, 0 bytes",
    ]


def test_csv() -> None:
    rows = list(csv.reader(io.StringIO(printed("csv"))))
    assert rows == [list(COLUMNS), ["1", "cup", "0.5", "", "616263"], ["12", "dining table", "nan", "3", ""]]


def test_json_is_strict() -> None:
    rows = json.loads(printed("json"), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert rows[0] == {"id": 1, "name": "cup", "score": 0.5, "count": None, "mask": "616263"}
    assert rows[1]["score"] is None


def test_values_of_servers_and_arrays() -> None:
    assert to_jsonable({"a": Decimal("3"), "b": Decimal("0.25"), "c": np.float32(0.5)}) == {"a": 3, "b": 0.25, "c": 0.5}
    assert to_jsonable((np.arange(2), np.array([np.nan]))) == [[0, 1], [None]]
    assert to_jsonable(datetime(2026, 5, 4, 3, 2, 1, tzinfo=UTC)) == "2026-05-04T03:02:01+00:00"
    assert cell_text(Decimal("2.50")) == "2.5"
    assert cell_text(1234567.891) == "1234567.891"


def test_an_empty_table_has_its_header() -> None:
    stream = io.StringIO()
    print_rows(("a", "bc"), [], "table", stream)
    assert stream.getvalue() == "a  bc\n-  --\n"


# progress


def test_durations() -> None:
    assert [format_duration(s) for s in (0, 59.4, 75.2, 3700, -1)] == ["0:00", "0:59", "1:15", "1:01:40", "0:00"]


def test_plain_progress_is_a_line_every_few_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("semdb.cli.progress.time.monotonic", lambda: now)
    stream = io.StringIO()
    with Progress("describing", stream=stream) as progress:
        for done in range(1, 41):
            now += 0.25
            progress.update(done, 40)
    assert stream.getvalue().splitlines() == [
        "describing: 20 of 40 frames, 4.0/s, 0:05 left",
        "describing: 40 of 40 frames, 4.0/s, 0:00 left",
    ]


def test_the_time_left_does_not_go_by_the_first_one(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 0.0
    monkeypatch.setattr("semdb.cli.progress.time.monotonic", lambda: now)
    stream = io.StringIO()
    with Progress("decoding", stream=stream) as progress:
        now = 20.0  # compiling
        for done in range(1, 22):
            progress.update(done, 250)
            now += 0.5
    assert stream.getvalue().splitlines() == [
        "decoding: 1 of 250 frames, 0.1/s",
        "decoding: 11 of 250 frames, 0.4/s, 2:00 left",
        "decoding: 21 of 250 frames, 0.7/s, 1:54 left",
    ]


def test_progress_of_work_that_goes_on_counts_what_is_new(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("semdb.cli.progress.time.monotonic", lambda: now)
    stream = io.StringIO()
    with Progress("training", "steps", stream=stream) as progress:
        progress.go_on(600, 640)
        for done in range(601, 611):
            now += 1
            progress.go_on(done, 640)
    assert stream.getvalue().splitlines() == [
        "training: 605 of 640 steps, 1.0/s, 0:35 left",
        "training: 610 of 640 steps, 1.0/s, 0:30 left",
    ]


def test_progress_on_a_terminal_is_a_bar() -> None:
    stream = io.StringIO()
    with Progress("describing", stream=stream, terminal=True) as progress:
        progress.update(3, 4)
        assert progress._bar.tasks[0].completed == 3
        assert progress._bar.tasks[0].total == 4
    assert progress._bar is None


def test_the_entry_point_is_installed() -> None:
    script = Path(sys.executable).parent / "semdb"
    result = subprocess.run([str(script), "--version"], capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.startswith("semdb ")
