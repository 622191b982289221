"""Whole commands on a damaged database: an answer, or one line that names the table; never a traceback."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import traceback
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.tables import metadata
from tests import damage

TABLES = "|".join(sorted((name.removesuffix("s") for name in metadata.tables), key=len, reverse=True))
AS_JSON = ("status", "refine", "loops", "localize", "index", "view")
CHOSEN = {  # one of each kind of harm; the others are in the long test
    "cameras.distortion: !nested",
    "cameras.fx: !zero",
    "cnn_vectors.vector: !not a number",
    "descriptors.data: !narrow",
    "keyframe_images.rgb: !large picture",
    "keyframes.tx: !infinite",
    "keypoints.data: !far outside",
    "models.config: !types",
    "objects.mask: !gigapixels",
    "refinements.parameters: !no JSON",
}


@dataclass
class Damaged:
    """A folder with a whole database, and what is run on a copy of it that was damaged."""

    folder: Path

    @property
    def file(self) -> Path:
        return self.folder / "damaged.sqlite3"

    def fresh(self) -> None:
        shutil.copy(self.folder / "whole.sqlite3", self.file)
        with closing(sqlite3.connect(self.file)) as connection:  # nobody is at work
            connection.execute("UPDATE ingest_items SET state = 'done', worker = NULL, lease_until = NULL")
            connection.commit()

    def execute(self, statement: str) -> None:
        with closing(sqlite3.connect(self.file)) as connection:
            assert connection.execute(statement).rowcount > 0
            connection.commit()

    def commands(self) -> dict[str, list[str]]:
        out = self.folder / "out"
        shutil.rmtree(out, ignore_errors=True)
        query = str(sorted((self.folder / "room" / "rgb").iterdir())[5])
        found = {
            "status": ["status", "--json"],
            "localize": ["localize", query, "--json"],
            "index": ["localize", query, "--json", "--coarse", "index"],
            "plot": ["localize", query, "--plot", str(out)],
            "refine": ["refine", "--force", "--json"],
            "keypoints": ["keypoints", "2", "--csv"],
            "show": ["show", "2", "--out", str(out / "show")],
            "loops": ["loops", "--json"],
            "objects": ["sql", "SELECT * FROM keyframe_objects"],
            "view": ["sql", "SELECT * FROM recording_summary", "--format", "json"],
            "doctor": ["doctor"],
        }
        for name in ("tum", "colmap", "kapture", "ply", "mcap", "semdb"):
            found[name] = ["export", name, "m", str(out / f"as-{name}")]
        return found

    def run(self, *names: str) -> dict[str, tuple[int, str]]:
        """Exit code and stderr of each command. Fails for a traceback, and for what is no line or names no table."""
        found = {}
        for name, arguments in self.commands().items():
            if names and name not in names:
                continue
            result = CliRunner().invoke(app, arguments)
            unknown = result.exception is not None and not isinstance(result.exception, SystemExit)
            assert not unknown, f"{name}: {''.join(traceback.format_exception(result.exception))[-3000:]}"
            assert result.exit_code in (0, 1), (name, result.stderr)
            assert "Traceback" not in result.output, result.output
            said = [line for line in result.stderr.splitlines() if line]
            if result.exit_code == 1 and name != "doctor":
                assert re.search(TABLES, said[-1]), (name, said)
            assert all(line.isprintable() and len(line) < 700 for line in said), said
            if name in AS_JSON and result.exit_code == 0:
                json.loads(result.stdout)
            found[name] = (result.exit_code, result.stderr)
        return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("damaged-commands")
    damage.make(folder)
    return folder


@pytest.fixture
def damaged(whole: Path, monkeypatch: pytest.MonkeyPatch) -> Damaged:
    found = Damaged(whole)
    found.fresh()
    for name, value in {
        "DATABASE_URL": f"sqlite:///{found.file}",
        "DETECTOR": "recorded",
        "ENCODER": "gist",
        "FEATURES": "orb",
        "MAX_KEYPOINTS": "200",
        "THREADS": "1",
        "CACHE_DIR": str(whole / "cache"),
    }.items():
        monkeypatch.setenv(f"SEMDB_{name}", value)
    return found


def names_of(kind: str) -> tuple[str, ...]:
    """The commands of the short test: those that draw and write files only where pictures are what is damaged."""
    light = ("status", "localize", "refine", "keypoints", "show", "loops", "objects", "view", "tum", "colmap", "semdb")
    return (*light, "plot", "mcap", "ply") if kind.startswith(("keyframe_images", "objects")) else light


@pytest.mark.parametrize("kind", sorted(CHOSEN))
def test_commands_on_damaged_rows(damaged: Damaged, kind: str) -> None:
    [chosen] = [one for one in damage.damages(False) if str(one) == kind]
    assert damage.apply(damaged.file, chosen) == 1
    damaged.run(*names_of(kind))


@pytest.mark.parametrize(
    ("table", "refused"),
    [
        ("cnn_vectors", set()),
        ("keyframe_images", {"show", "colmap"}),
        ("keypoints", {"show", "keypoints", "colmap"}),
        ("descriptors", {"colmap"}),
    ],
)
def test_a_row_that_is_missing_is_said(damaged: Damaged, table: str, refused: set[str]) -> None:
    damaged.execute(f"DELETE FROM {table} WHERE keyframe_id = 2")
    said = f"{table} has no row of keyframe 2"
    found = damaged.run("localize", "index", "show", "keypoints", "colmap", "refine", "tum", "semdb")
    assert {name for name, (code, _) in found.items() if code} == refused
    for name in ("colmap", "tum", "semdb"):  # what fails leaves no part of it behind
        assert (damaged.folder / "out" / f"as-{name}").exists() == (name not in refused)
    for name in ("localize", "index", *refused):
        assert said in found[name][1], (name, found[name])
    for name in ("localize", "index"):
        assert found[name][1].count("semdb delete keyframes 2 removes it") == 1


@pytest.mark.long
def test_all_commands_on_damaged_rows_of_every_kind(damaged: Damaged) -> None:
    for one in damage.damages(False):
        damaged.fresh()
        if damage.apply(damaged.file, one):
            try:
                damaged.run()
            except AssertionError as error:
                raise AssertionError(f"{one}: {error}") from error
