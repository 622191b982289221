"""The wheel outside the checkout: one top-level package, migrations inside, `semdb init` works."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SOURCES = ("pyproject.toml", "setup.py", "README.md", "LICENSE", "semdb", "migrations", "workers")


def run(*command: str | Path, cwd: Path, env: dict[str, str] | None = None) -> str:
    """Run a command that must succeed; its stdout."""
    result = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=env, capture_output=True, text=True, check=False, timeout=300
    )
    assert result.returncode == 0, f"{command}: {result.stdout}{result.stderr}"
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built from a copy of the sources, so that nothing left over in the checkout gets into it."""
    source = tmp_path_factory.mktemp("source")
    for name in SOURCES:
        origin = REPOSITORY / name
        if origin.is_dir():
            shutil.copytree(origin, source / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(origin, source / name)
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", source / "dist", source, cwd=source)
    (built,) = (source / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="module")
def clean_python(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new environment with semdb from the wheel; its dependencies are those of the environment of the tests."""
    folder = tmp_path_factory.mktemp("clean") / "venv"
    run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
    python = folder / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python, "install"]
    run(*pip, "--no-deps", "--no-index", "--quiet", wheel, cwd=folder.parent)
    # Last, or pip would find the tests' own semdb. A path file is not followed by those in the folder it names, so
    # an editable install there stays out of sight.
    own = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=folder.parent).strip()
    paths = dict.fromkeys((sysconfig.get_path("purelib"), sysconfig.get_path("platlib")))
    (Path(own) / "dependencies.pth").write_text("\n".join(paths) + "\n")
    return python


@pytest.fixture
def environment() -> dict[str, str]:
    """The environment without settings of semdb and without PYTHONPATH."""
    return {name: value for name, value in os.environ.items() if not name.startswith(("SEMDB_", "PYTHON"))}


def test_it_holds_one_top_level_package(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"semdb", wheel.name.rsplit("-", 3)[0] + ".dist-info"}
    assert "semdb/py.typed" in names
    assert "semdb/workers/tasks.py" in names
    assert [name for name in names if name.endswith("licenses/LICENSE")]


def test_it_holds_every_module_of_the_checkout(wheel: Path) -> None:
    names = set(zipfile.ZipFile(wheel).namelist())
    expected = {path.relative_to(REPOSITORY).as_posix() for path in (REPOSITORY / "semdb").rglob("*.py")}
    for package in ("migrations", "workers"):
        files = (REPOSITORY / package).rglob("*.py")
        expected |= {f"semdb/{path.relative_to(REPOSITORY).as_posix()}" for path in files}
    assert {name for name in names if name.endswith(".py")} == expected
    assert "semdb/migrations/env.py" in names


def test_init_outside_the_checkout(clean_python: Path, environment: dict[str, str], tmp_path: Path) -> None:
    where = run(clean_python, "-c", "import semdb; print(semdb.__file__)", cwd=tmp_path, env=environment)
    assert Path(where.strip()).is_relative_to(clean_python.parent.parent)

    semdb = clean_python.parent / "semdb"
    assert run(semdb, "--version", cwd=tmp_path, env=environment).startswith("semdb ")
    assert "created" in run(semdb, "init", cwd=tmp_path, env=environment)
    assert [path.name for path in tmp_path.glob("*.sqlite3")] == ["semdb.sqlite3"]
    with sqlite3.connect(tmp_path / "semdb.sqlite3") as connection:
        tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    assert {"maps", "recordings", "keyframes", "objects", "descriptors", "queries", "alembic_version"} <= tables
    assert "up to date" in run(semdb, "init", cwd=tmp_path, env=environment)


def test_the_worker_application_is_importable(clean_python: Path, environment: dict[str, str], tmp_path: Path) -> None:
    code = (
        "from semdb.workers import app; import semdb.workers.tasks; print(sorted(t for t in app.tasks if 'semdb' in t))"
    )
    found = run(clean_python, "-c", code, cwd=tmp_path, env=environment).strip()
    assert found == "['semdb.ingest_items', 'semdb.ingest_recording']"


def test_an_older_python_is_told_which_one_is_needed() -> None:
    """Not by the name of the first dependency that has no version for it."""
    code = "import sys; sys.version_info = (3, 10, 13); sys.version = '3.10.13 (main)'; exec(open('setup.py').read())"
    done = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("semdb needs Python 3.11 or newer, and this is 3.10.13: docs/install.md")
