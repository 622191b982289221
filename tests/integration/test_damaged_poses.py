"""Damaged rows of links, of moves and of how sure poses are: an answer or one line, never a traceback."""

from __future__ import annotations

import itertools
import shutil
import sqlite3
import traceback
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.moving import move
from semdb.database.pose_records import Link, LinkKind, LinkState, Move, OperationKind
from semdb.database.store import open_store
from semdb.geometry import invert_pose, pose_from
from tests import damage

TABLES = ("loop_closures", "pose_sources", "pose_covariances", "pose_operations", "pose_revisions")
HARM = {
    "text": "'\x1b[2Jx'",
    "blob": "x'00ff00'",
    "huge": "9e999",
    "negative": "-1",
    "large": "4611686018427387904",
    "empty": "''",
    "nothing": "NULL",
    "long": "printf('%.*c', 2000000, 'x')",
    "json": '\'{"before": {"tx": [1], "pose_source": 3}, "token": {}}\'',
}
CHOSEN = {
    ("loop_closures", "information", "blob"),
    ("pose_operations", "parameters", "json"),
    ("pose_revisions", "before_qw", "empty"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database whose keyframes were moved once, with links and covariances."""
    folder = tmp_path_factory.mktemp("damaged-poses")
    damage.make(folder)
    with open_store(f"sqlite:///{folder / 'whole.sqlite3'}") as store:
        [info] = store.maps()
        heads = store.keyframe_heads(info.id)
        before = {one.id: one.world_from_camera for one in heads}
        links = [
            Link(
                one.id, two.id, kind, invert_pose(one.world_from_camera) @ two.world_from_camera, np.eye(6) * 1e4, 50,
                LinkState.ACCEPTED, "", "test",
            )
            for kind in (LinkKind.ODOMETRY, LinkKind.LOOP)
            for one, two in itertools.pairwise(heads)
        ]  # fmt: skip
        shift = pose_from(np.eye(3), [0.1, 0.0, 0.0])
        after = {key: shift @ pose for key, pose in before.items()}
        spread = dict.fromkeys(before, np.eye(6) * 1e-4)
        move(store.engine, Move(OperationKind.REFINE, info.id, before, after, links=tuple(links), covariances=spread))
    return folder


@pytest.fixture
def file(whole: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    copy = whole / "damaged.sqlite3"
    for name, value in {
        "DATABASE_URL": f"sqlite:///{copy}",
        "DETECTOR": "recorded",
        "ENCODER": "gist",
        "FEATURES": "orb",
        "MAX_KEYPOINTS": "200",
        "THREADS": "1",
        "CACHE_DIR": str(whole / "cache"),
    }.items():
        monkeypatch.setenv(f"SEMDB_{name}", value)
    yield copy
    copy.unlink(missing_ok=True)


def columns(whole: Path) -> list[tuple[str, str]]:
    with closing(sqlite3.connect(whole / "whole.sqlite3")) as connection:
        return [(t, str(row[1])) for t in TABLES for row in connection.execute(f"PRAGMA table_info({t})")]


def harmed(whole: Path, copy: Path, table: str, column: str, harm: str) -> bool:
    """A fresh copy with one row harmed; False where the schema does not let that in."""
    shutil.copy(whole / "whole.sqlite3", copy)
    with closing(sqlite3.connect(copy)) as connection:
        try:
            row = f"(SELECT rowid FROM {table} ORDER BY rowid LIMIT 1)"
            connection.execute(f"UPDATE {table} SET {column} = {HARM[harm]} WHERE rowid = {row}")
        except sqlite3.IntegrityError:
            return False
        connection.commit()
    return True


def check(whole: Path, what: str) -> None:
    out = whole / "out"
    shutil.rmtree(out, ignore_errors=True)
    query = str(sorted((whole / "room" / "rgb").iterdir())[5])
    commands = (
        ["status", "--json"],
        ["loops", "--all", "--json"],
        ["export", "g2o", "m", str(out / "links.g2o")],
        ["export", "semdb", "m", str(out / "map")],
        ["localize", query, "--json"],
        ["sql", "SELECT * FROM keyframe_links"],
        ["refine", "--step", "poses", "--force"],
        ["align", "--undo", "--map", "m"],
    )
    for arguments in commands:
        result = CliRunner().invoke(app, arguments)
        unknown = result.exception is not None and not isinstance(result.exception, SystemExit)
        where = f"{what}: semdb {' '.join(arguments)}"
        assert not unknown, f"{where}: {''.join(traceback.format_exception(result.exception))[-3000:]}"
        assert result.exit_code in (0, 1, 2), (where, result.stderr)
        assert "Traceback" not in result.output, where
        said = [line for line in result.stderr.splitlines() if line]
        assert all(line.isprintable() and len(line) < 700 for line in said), (where, said)


@pytest.mark.parametrize("harm", sorted(CHOSEN), ids=" ".join)
def test_a_damaged_row(whole: Path, file: Path, harm: tuple[str, str, str]) -> None:
    assert harmed(whole, file, *harm)
    check(whole, " ".join(harm))


@pytest.mark.long
def test_every_column(whole: Path, file: Path) -> None:
    for (table, column), harm in itertools.product(columns(whole), HARM):
        if harmed(whole, file, table, column, harm):
            check(whole, f"{table}.{column} {harm}")
