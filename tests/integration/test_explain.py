"""No statement that semdb sends reads a big table from end to end."""

from __future__ import annotations

import contextlib
import inspect
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import pytest
from sqlalchemy import inspect as inspect_database
from sqlalchemy import text
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.errors import NotFoundError
from semdb.types import Int64Array, Localization, Verdict
from tests.big_database import FIRST_KEYFRAME, FRAMES, PLANNED, RECORDINGS, fill_big
from tests.database_samples import MODELS, description, plan, record
from tests.query_plans import checked_plans

KEYFRAMES = list(range(FIRST_KEYFRAME, FIRST_KEYFRAME + 40, 3))
COUNTS = {"chair": 2.0, "cup": 1.0, "no such thing": 1.0}


@dataclass(frozen=True)
class Big:
    """A database full of rows. Tests share it, and each changes what no other one looks at."""

    store: Store
    url: str
    map_ids: list[int]


@pytest.fixture(scope="module", params=["sqlite", "mariadb", "mysql"])
def big(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Big]:
    with contextlib.ExitStack() as stack:
        if request.param == "sqlite":
            url = f"sqlite:///{tmp_path_factory.mktemp('big') / 'semdb.sqlite3'}"
        else:
            url = stack.enter_context(request.getfixturevalue(f"{request.param}_server").schema())
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        store = stack.enter_context(open_store(url))
        yield Big(store, url, fill_big(store))


def test_statements_without_an_index_are_caught(big: Big) -> None:
    bad = [
        "SELECT id FROM objects WHERE score > 0.99",
        "SELECT id FROM keyframes WHERE tx > 1000",
        "SELECT COUNT(*) FROM keyframe_categories WHERE count = 77",
        "UPDATE ingest_items SET attempts = 9 WHERE worker = 'nobody'",
        "DELETE FROM queries WHERE stage = 'nowhere'",
        "SELECT a.id FROM keyframe_changes a JOIN keyframe_changes b ON b.changed_at = a.changed_at WHERE a.id = 77",
        "SELECT o.id FROM categories c JOIN objects o ON o.score > c.id WHERE c.name = 'chair'",
        "SELECT keyframe_id, COUNT(*) FROM objects WHERE score > 0.1 GROUP BY keyframe_id",
    ]
    good = [
        "SELECT id FROM objects WHERE keyframe_id = 10001",
        "SELECT COUNT(*) FROM keyframes",
        "SELECT recording_id, COUNT(*) FROM keyframes GROUP BY recording_id",
        "SELECT object_id FROM keyframe_objects WHERE keyframe_id = 10001",
        "DELETE FROM queries WHERE id = 10001",
        "SELECT name FROM categories WHERE id + 0 = 1",
    ]
    for statement, expected in (*((s, True) for s in bad), *((s, False) for s in good)):
        with checked_plans() as check, big.store.engine.connect() as connection:
            connection.execute(text(statement))  # and rolled back
        assert bool(check.full_scans) == expected, (statement, check.full_scans)
        assert check.statements == {statement}


def test_all_that_the_store_sends_uses_indexes(big: Big) -> None:
    with checked_plans() as check:
        called = _call_everything(big.store, big.map_ids)
    public = {name for name in vars(Store) if not name.startswith("_")}
    assert called == public - {"close", "url"}
    assert len(check.statements) > 40
    assert not check.full_scans, "\n".join(check.full_scans)
    assert len(big.store.keyframe_ids(big.map_ids[0])) == RECORDINGS * FRAMES + 1
    assert len(big.store.keyframe_ids(big.map_ids[3])) == RECORDINGS * FRAMES - 20
    with pytest.raises(NotFoundError):
        big.store.find_map("big 6")


def _call_everything(store: Store, map_ids: list[int]) -> set[str]:
    """Call every public method with arguments by the names of its parameters: what deletes, last."""
    methods = [name for name, member in vars(Store).items() if callable(member) and not name.startswith("_")]
    methods.remove("close")
    called = set()
    for name in sorted(methods, key=lambda name: name.startswith("delete")):
        method = getattr(store, name)
        for arguments in _arguments(name, method, _values(store, map_ids)):
            result = method(**arguments)
            if isinstance(result, Iterator):
                list(result)
        called.add(name)
    return called


def _values(store: Store, map_ids: list[int]) -> dict[str, Any]:
    """A value for each name of a parameter; for one method alone under ``method.parameter``."""
    (first, *_) = (status.recording_id for status in store.status(map_ids[0]))
    (last, *_) = (status.recording_id for status in store.status(map_ids[7]))
    lost = Localization(Verdict.FAILED, "big 0", None, None, 0.1, 3, "all", (), 1.0, 4, "no texture", {"total": 9.0})
    return {
        "map_id": map_ids[0],
        "delete_map.map_id": map_ids[6],
        "recording_id": first,
        "delete_recording.recording_id": last,
        "keyframe_id": FIRST_KEYFRAME + 5,
        "keyframe_ids": np.array(KEYFRAMES),
        "delete_keyframes.keyframe_ids": [FIRST_KEYFRAME + 3 * FRAMES * RECORDINGS + i for i in range(20)],
        "name": "big 0",
        "find_recording.name": "visit 1",
        "map_name": "big 0",
        "recording": "visit 1",
        "models": MODELS,
        "plan": plan("visit 0", range(PLANNED), frames=200),
        "record": record(1, description(1, ["chair"])),
        "write_keyframe.record": record(FRAMES + 3, description(10, ["chair", "cup"])),
        "frame_index": FRAMES + 5,
        "error": "made up",
        "state": "made up",
        "counts": COUNTS,
        "query": store.class_query(map_ids[0], COUNTS),
        "at_most": 20,
        "categories": list(COUNTS),
        "minimum_share": 0.5,
        "completed": True,
        "change_id": 500,
        "vector": np.ones(128, np.float32),
        "encoder": store.encoder_id(map_ids[0]),
        "image": "query.png",
        "localization": lost,
        "worker": "a worker",
        "parameters": {},
        "write": lambda *_: 0,
        "result": (),
    }


def _arguments(name: str, method: Callable[..., Any], values: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The arguments of one call with all parameters, and of one without those that may be left out."""
    everything, needed = {}, {}
    hints = get_type_hints(method)
    for parameter in inspect.signature(method).parameters.values():
        key, optional = parameter.name, parameter.default is not inspect.Parameter.empty
        value = values.get(f"{name}.{key}", values.get(key))
        if value is None and not optional:
            value = _made_up(hints[key])
        if value is None and not optional:
            pytest.fail(f"Store.{name} takes {key!r}: give a value for it in _values")
        if value is not None:
            everything[key] = value
        if not optional:
            needed[key] = value
    return [everything] if everything.keys() == needed.keys() else [everything, needed]


def _made_up(hint: Any) -> Any:
    """A value of a type, for parameters that nothing is known of."""
    if get_origin(hint) in (Sequence, Iterable, Collection):
        return {int: KEYFRAMES, str: list(COUNTS)}.get(get_args(hint)[0])
    if hint == Int64Array:
        return np.array(KEYFRAMES)
    return {int: 1, float: 1.0, str: "made up", bool: True}.get(hint)


def test_all_that_commands_send_uses_indexes(
    big: Big, room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    images = sorted((room / "rgb").iterdir())
    for name in [name for name in os.environ if name.startswith("SEMDB_")]:
        monkeypatch.delenv(name)
    for name, value in (("DATABASE_URL", big.url), ("CACHE_DIR", str(tmp_path)), ("THREADS", "1")):
        monkeypatch.setenv(f"SEMDB_{name}", value)
    commands = [
        ["init"],
        ["ingest", room, "--map", "room", "--keyframes", 6, "--detector", "recorded", "--encoder", "gist"],
        ["status"],
        ["status", "--map", "big 4"],
        ["localize", images[4], images[9], "--map", "room", "--json", "--coarse", "sql"],
        ["localize", images[4], images[9], "--map", "room", "--json", "--coarse", "index"],
        ["refine", "--map", "room"],
        ["keypoints", FIRST_KEYFRAME + FOURTH, "--csv"],
        ["retry"],
        ["delete", "keyframes", FIRST_KEYFRAME + FOURTH, "--yes"],
        ["delete", "recording", "visit 2", "--map", "big 4", "--yes"],
        ["delete", "map", "big 5", "--yes"],
    ]
    with checked_plans() as check:
        for command in commands:
            done = CliRunner().invoke(app, [str(word) for word in command])
            assert done.exit_code == 0, (command, done.output)
    assert len(check.statements) > 40
    assert not check.full_scans, "\n".join(check.full_scans)


FOURTH = 4 * RECORDINGS * FRAMES
VIEWS = (
    "SELECT * FROM keyframe_objects WHERE map = 'big 0' AND recording = 'visit 1'",
    "SELECT * FROM keyframe_objects WHERE keyframe_id = 10001",
    "SELECT * FROM keyframe_objects WHERE map = 'big 0' AND category = 'chair'",
    "SELECT * FROM category_counts WHERE map = 'big 0'",
    "SELECT * FROM recording_summary WHERE map = 'big 0'",
    "SELECT * FROM covisible_objects WHERE keyframe_id = 10001",
    "SELECT * FROM keypoint_counts WHERE map = 'big 0' AND recording = 'visit 1'",
    "SELECT * FROM queries WHERE map_id = 2 AND created_at > '2020-01-01' ORDER BY created_at DESC LIMIT 5",
)


def test_views_asked_for_a_part_use_indexes(big: Big) -> None:
    with checked_plans() as check, big.store.engine.connect() as connection:
        counts = [len(connection.execute(text(statement)).all()) for statement in VIEWS]
    assert counts[0] == 3 * FRAMES
    assert min(counts) > 0
    assert not check.full_scans, "\n".join(check.full_scans)


def test_deleting_cascades_through_indexes(big: Big) -> None:
    """A plan does not show what a foreign key sets off: the columns that refer to others begin an index."""
    inspector = inspect_database(big.store.engine)
    without = []
    for table in inspector.get_table_names():
        indexes = [index["column_names"] for index in inspector.get_indexes(table)]
        indexes += [unique["column_names"] for unique in inspector.get_unique_constraints(table)]
        indexes.append(inspector.get_pk_constraint(table)["constrained_columns"])
        for key in inspector.get_foreign_keys(table):
            columns = key["constrained_columns"]
            if not any(index[: len(columns)] == columns for index in indexes):
                without.append((table, columns))
    assert without == []
