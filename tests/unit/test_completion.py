"""What TAB offers: by the function that the scripts of the shells call, and in bash and zsh on a terminal."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from semdb.cli.completion import VARIABLE, Line, answer, offer, split_line, values
from semdb.cli.completion.shells import BASH, ZSH, Shell, install
from semdb.cli.main import COMMANDS, app
from semdb.database.store import open_store
from semdb.evaluation.methods import METHODS
from semdb.exchange.formats import FORMATS
from semdb.recordings.options import AXES, CAMERA_FROM_WORLD, QUATERNIONS, WORLD_FROM_CAMERA
from semdb.refinement.run import STEPS
from tests.database_samples import fill
from tests.terminal import Terminal
from tests.unit.test_cli import HEAVY

BIN = Path(sys.executable).parent


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        fill(store, name="first visit")
        fill(store, map_name="hall 2", name="corridor", seed=9)
    (tmp_path / "photo.png").write_bytes(b"")
    (tmp_path / "net.onnx").write_bytes(b"")


def offered(line: str, **environment: str) -> list[str]:
    found = offer(typer.main.get_command(app), split_line(line), {"SEMDB_CACHE_DIR": "nowhere", **environment})
    return [value for value, _ in found.entries] + ["FILES"] * found.files


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("semdb lo", Line((), "lo", False)),
        ("semdb ", Line((), "", False)),
        ("semdb sql 'SELECT 1' --for", Line(("sql", "SELECT 1"), "--for", False)),
        ("semdb localize 'my ph", Line(("localize",), "my ph", True)),
        (r"semdb localize my\ ph", Line(("localize",), "my ph", False)),
        ("semdb localize my\\", Line(("localize",), "my\\", False)),
    ],
)
def test_lines_are_split_as_a_shell_does(line: str, expected: Line) -> None:
    assert split_line(line) == expected


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("semdb ", list(COMMANDS)),
        ("semdb lo", ["loops", "localize"]),
        ("semdb delete ", ["recording", "map", "keyframes"]),
        ("semdb --in", ["--install-completion"]),
        ("semdb localize --map ", ["hall 2", "room"]),
        ("semdb localize --map=r", ["room"]),
        ("semdb localize --map room --m", []),  # given once is enough
        (
            "semdb localize --depth a.png --dept",
            ["--depth", "--depth-scale", "--depth-offset-ms", "--depth-camera", "--depth-topic"],
        ),  # may be repeated
        ("semdb localize --like ", ["corridor", "first visit", "FILES"]),
        ("semdb localize --coarse ", ["sql", "index"]),
        ("semdb localize ", ["FILES"]),
        ("semdb localize --plot ", ["FILES"]),
        ("semdb localize --traj", ["--trajectory"]),
        ("semdb show ", ["FILES"]),
        ("semdb localize --camera ", []),
        ("semdb localize -- --", ["FILES"]),
        ("semdb ingest ", ["FILES"]),
        ("semdb sql --format ", ["table", "csv", "json"]),
        ("semdb delete recording f", ["first visit"]),
        ("semdb delete map ", ["hall 2", "room"]),
        ("semdb models pull resnet50-", ["resnet50-places365"]),
        ("semdb ingest --detector onnx:", ["onnx:net.onnx", "onnx:", "FILES"]),
        ("semdb ingest --encoder g", ["gist", "FILES"]),
        ("semdb export p", ["ply"]),
        ("semdb export ply ", ["hall 2", "room"]),
        ("semdb localize --axes o", ["opencv", "opengl"]),
        ("semdb nothing --map ", []),
        ("semdb doctor x ", []),
    ],
)
def test_what_fits_is_offered(line: str, expected: list[str]) -> None:
    assert offered(line) == expected


def test_names_are_those_of_the_database_that_the_line_names() -> None:
    assert offered("semdb status --database-url sqlite:///none.sqlite3 --map ") == []
    assert offered("semdb status --map ", SEMDB_DATABASE_URL="sqlite:///none.sqlite3") == []
    assert offered("semdb status --map ", SEMDB_DATABASE_URL="mysql+pymysql://a:b@127.0.0.1:9/x") == []
    Path("none.sqlite3").write_text("no database")
    assert offered("semdb status --map ", SEMDB_DATABASE_URL="sqlite:///none.sqlite3") == []
    before = sorted(path.name for path in Path().iterdir())
    assert offered(f"semdb status --database-url sqlite:///{Path('semdb.sqlite3').absolute()} --map h") == ["hall 2"]
    assert sorted(path.name for path in Path().iterdir()) == before


def test_names_are_no_code_of_the_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    names = [
        "room$(reboot)",
        'room"; reboot; "',
        "room`reboot`",
        "room\\",
        "room\x1b[31m",
        "room\nforged",
        "room 2",
        "rooms",
    ]
    with sqlite3.connect("semdb.sqlite3") as connection:
        connection.execute("UPDATE maps SET name = 'room' || char(10) || 'forged\tx' WHERE name = 'hall 2'")
        connection.executemany("INSERT INTO maps (name) VALUES (?)", [(name,) for name in names])
    for line, expected in (
        (
            "semdb status --map ro",
            {"room", "room$(reboot)", 'room"; reboot; "', "room`reboot`", "room\\", "room 2", "rooms"},
        ),
        ('semdb status --map "ro', {"room", "room 2", "rooms"}),
        ("semdb status --database-url 'sqlite:///semdb.sqlite3' --map ro", {"room", "room 2", "rooms"}),
    ):
        monkeypatch.setenv(VARIABLE, line)
        kind, *lines = answer(typer.main.get_command(app)).split("\n")
        assert kind == "plain"
        assert {entry.split("\t")[0] for entry in lines} == expected
    monkeypatch.setenv(VARIABLE, "semdb delete recording corr")  # its description names the map
    assert answer(typer.main.get_command(app)).split("\n")[1:] == [
        r"corridor	a recording in the map room\nforged\tx"
    ]


def test_fixed_values_are_those_that_there_are() -> None:
    assert set(values.METHODS) <= set(METHODS)
    assert list(values.EXPORTS) == list(FORMATS)
    assert [name for name, _ in values.FIXED["--axes"]] == list(AXES)
    assert [name for name, _ in values.FIXED["--quaternion"]] == list(QUATERNIONS)
    assert [name for name, _ in values.FIXED["--poses-are"]] == [WORLD_FROM_CAMERA, CAMERA_FROM_WORLD]
    assert [name for name, _ in values.FIXED["--step"]] == [step.kind for step in STEPS]


def test_it_is_quick_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from semdb.cli.main import main\n"
        "main()\n"
        "print('MODULES', *{name.split('.')[0] for name in sys.modules})"
    )
    for line in ("semdb ", "semdb localize --map ", "semdb evaluate --"):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "_SEMDB_COMPLETE": line},
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        assert done.stdout.startswith("plain\n")
        assert not set(done.stdout.rpartition("MODULES")[2].split()) & HEAVY


def run_in(shell: Shell, *arguments: str) -> subprocess.CompletedProcess[str]:
    """``semdb ARGUMENTS`` called from the shell, whose home is the current folder."""
    script = f"{BIN / 'semdb'} {' '.join(arguments)}; exit $?"
    environment = {"HOME": os.getcwd(), "PATH": f"{BIN}:/usr/bin:/bin", "SHELL": "/bin/false"}
    return subprocess.run(
        [shell.name, "-c", script], env=environment, capture_output=True, text=True, timeout=60, check=False
    )


def shell_of(name: str) -> Shell:
    if shutil.which(name) is None:
        pytest.skip(f"no {name} on this machine")
    script, start_file = {"bash": (BASH, ".bashrc"), "zsh": (ZSH, ".zshrc")}[name]
    return Shell(name, script, Path(start_file).absolute())


@pytest.mark.parametrize("name", ["bash", "zsh"])
def test_installing_adds_one_line_and_keeps_the_rest(name: str) -> None:
    shell = shell_of(name)
    shell.start_file.write_bytes(b"alias ll='ls -l'\n# caf\xe9")  # of whatever encoding
    for _ in range(2):
        done = run_in(shell, "--install-completion")
        assert done.returncode == 0, done.stderr
    script = Path(".local/share/semdb") / f"completion.{name}"
    assert f"completion for {name} is in {script.absolute()}" in done.stdout
    assert script.read_text() == shell.script
    lines = shell.start_file.read_bytes().splitlines()
    assert lines[:2] == [b"alias ll='ls -l'", b"# caf\xe9"]
    assert len(lines) == 3
    assert str(script).encode() in lines[2]
    assert run_in(shell, "--show-completion").stdout == shell.script


def test_other_shells_are_told_so() -> None:
    done = run_in(shell_of("bash"), "--install-completion")
    assert done.returncode == 0
    code = "import semdb.cli.completion.shells as s; s._calling_shell = lambda: 'fish'; s.current_shell()"
    done = subprocess.run(
        [sys.executable, "-c", code], env={"SHELL": "/usr/bin/fish"}, capture_output=True, text=True, check=False
    )
    assert "completion is there for bash and zsh, and this is fish" in done.stderr


@pytest.mark.parametrize("name", ["bash", "zsh"])
def test_tab_on_a_terminal(name: str) -> None:
    shell = shell_of(name)
    install(shell)
    Path("with space").mkdir()
    command = {"bash": ["bash", "--rcfile", ".bashrc", "-i"], "zsh": ["zsh", "-i"]}[name]
    clear = "\x15"
    with Terminal(*command, PS1="$ ", SEMDB_CACHE_DIR=os.getcwd()) as terminal:
        terminal.type("echo rea''dy\n", "ready\r\n")
        terminal.type("semdb loc\t", "localize ")
        terminal.type("--ma\t", "--map ")
        terminal.type("ro\t", "room ")
        terminal.type("pho\t", "photo.png ")
        terminal.type(f"{clear}semdb delete map ha\t", r"hall\ 2 ")
        terminal.type(f"{clear}semdb ingest --detector onnx:n\t", "net.onnx ")
        terminal.type(f"{clear}semdb status --map=ro\t", "--map=room ")
        terminal.type(f"{clear}semdb ingest with\t", r"with\ space/")
        shown = terminal.type(f"{clear}semdb models \t\t", "pull")
        assert "list" in shown
        assert "pull" in shown
