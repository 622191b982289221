"""`semdb changes` on every server: what visits say of landmarks is stored, read, compared, shown and copied."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import select, text
from typer.testing import CliRunner

from semdb.api.changing import changes_of
from semdb.cli.main import app
from semdb.database import landmark_tables, tables
from semdb.database.copying import copy_map
from semdb.database.landmark_records import GravityRow, LandmarkRow, LandmarkSet, LandmarkSighting, LandmarkVisit
from semdb.database.landmark_rows import LANDMARKS, replace_landmarks
from semdb.database.store import Store, open_store
from semdb.errors import NotFoundError, UsageError
from semdb.landmarks.appearance import LENGTH
from semdb.landmarks.identity import keep_ids
from semdb.pictures.localization import landmark_objects
from tests.database_samples import fill

FIRST, SECOND = "first visit", "second visit"
SIZE = (0.1, 0.1, 0.12)


def present(recording: str, x: float, points: int = 0) -> LandmarkVisit:
    return LandmarkVisit(recording, "present", 3, points, points, 0, 0, 0, (x, 0.0, 0.8), SIZE)


def absent(recording: str) -> LandmarkVisit:
    return LandmarkVisit(recording, "absent", 0, 100, 5, 90, 5, 0, None, None)


def stored(store: Store) -> tuple[int, list[int]]:
    """Two recordings: a cup that moved, a book that is gone, a table that stays, a chair that one did not look at."""
    map_id, _, _ = fill(store, name=FIRST)
    fill(store, name=SECOND)
    visits = {
        "cup": (present(FIRST, 0.0), absent(SECOND)),
        "bowl": (absent(FIRST), present(SECOND, 0.5)),
        "book": (present(FIRST, 3.0), absent(SECOND)),
        "dining table": (present(FIRST, 1.0, 100), present(SECOND, 1.0, 100)),
        "chair": (present(FIRST, 2.0), replace(absent(SECOND), presence="unobserved", seen_through=0, occluded=90)),
    }
    objects, keyframes = tables.objects.c, tables.keyframes.c
    joined = tables.objects.join(tables.keyframes).join(tables.recordings)
    query = select(objects.id, keyframes.id.label("keyframe_id"), tables.recordings.c.name).select_from(joined)
    with store.engine.begin() as connection:
        for name in visits:
            if not connection.execute(text("SELECT id FROM categories WHERE name = :name"), {"name": name}).first():
                connection.execute(text("INSERT INTO categories (name) VALUES (:name)"), {"name": name})
        seen = connection.execute(query.order_by(objects.id)).all()
    rows = []
    for number, (name, said) in enumerate(visits.items()):
        shown = [visit.recording for visit in said if visit.presence == "present"]
        mine = [row for row in seen if row.name in shown][number :: len(visits)]
        position = next(visit.position for visit in said if visit.position is not None)
        kind = "cup" if name == "bowl" else name
        rows.append(
            LandmarkRow(
                *(kind, 0.97, {kind: 0.97}, position, np.eye(3) * 1e-4, SIZE, 0.0, 3, 0, 0, "confirmed"),
                *(mine[0].keyframe_id, mine[-1].keyframe_id, None, None),
                tuple(LandmarkSighting(row.id, 0.9, 0.8) for row in mine),
                (),
                said,
                np.eye(LENGTH, dtype=np.float32)[3],
            )
        )
    found = LandmarkSet(tuple(rows), (), GravityRow((0.0, 0.0, 1.0), 0.9, 0.0, 0.8, given=False))
    state = store.map_state(map_id)
    store.replace_refinement(
        map_id,
        LANDMARKS,
        state,
        {},
        lambda connection, key, result: replace_landmarks(connection, key, result, keep_ids),
        found,
    )
    with store.engine.connect() as connection:
        return map_id, list(
            connection.execute(
                select(landmark_tables.landmarks.c.id).order_by(landmark_tables.landmarks.c.id)
            ).scalars()
        )


def test_what_changed(store: Store) -> None:
    _, (cup, new, book, table, chair) = stored(store)
    found = changes_of(store, FIRST, SECOND, None)
    assert [(c.kind, c.category, c.landmark_id, c.other_landmark_id) for c in found.changes] == [
        ("disappeared", "book", book, None),
        ("moved", "cup", cup, new),
    ]
    gone, moved = found.changes
    assert (gone.before.position, gone.after.presence, gone.after.seen_through) == ((3.0, 0.0, 0.8), "absent", 90)
    assert moved.distance == pytest.approx(0.5)
    assert moved.before.crop is not None
    assert moved.after.crop is not None
    assert moved.after.position == (0.5, 0.0, 0.8)
    assert found.counts == {"appeared": 0, "disappeared": 1, "moved": 1, "in_both": 1, "not_looked_at": 1}
    assert {item.landmark_id: (item.before.presence, item.after.presence) for item in found.landmarks} == {
        cup: ("present", "absent"),
        new: ("absent", "present"),
        book: ("present", "absent"),
        table: ("present", "present"),
        chair: ("present", "unobserved"),
    }
    back = changes_of(store, SECOND, FIRST, "room")
    assert [(c.kind, c.landmark_id, c.other_landmark_id) for c in back.changes] == [
        ("appeared", book, None),
        ("moved", new, cup),
    ]
    with store.engine.connect() as connection:
        query = "SELECT category, presence, points, seen_through FROM landmark_visit_list WHERE recording = :name"
        rows = connection.execute(text(query + " ORDER BY landmark_id"), {"name": SECOND}).all()
    assert [tuple(row) for row in rows] == [
        ("cup", "absent", 100, 90),
        ("cup", "present", 0, 0),
        ("book", "absent", 100, 90),
        ("dining table", "present", 100, 0),
        ("chair", "unobserved", 100, 0),
    ]


def test_the_map_from_above_agrees_with_sql(store: Store) -> None:
    map_id, _ = stored(store)
    with store.engine.connect() as connection:
        query = "SELECT category, x, y, z, size_x, size_y, size_z, yaw FROM landmark_list WHERE state = 'confirmed'"
        rows = {(row.category, row.x): row for row in connection.execute(text(query))}
    shown = landmark_objects(store, map_id)
    assert len(shown) == len(rows) == 5
    for item in shown:
        assert item.footprint is not None
        row = rows[item.category, item.position[0]]
        assert item.position.tolist() == [row.x, row.y, row.z]
        along, across = item.footprint[1] - item.footprint[0], item.footprint[3] - item.footprint[0]
        assert [np.linalg.norm(along), np.linalg.norm(across)] == pytest.approx([row.size_x, row.size_y])
        assert np.arctan2(along[1], along[0]) == pytest.approx(row.yaw)
        assert item.footprint.mean(axis=0) == pytest.approx([row.x, row.y, row.z - row.size_z / 2])
    fill(store, name="third visit")  # landmarks are out of date now
    assert landmark_objects(store, map_id) == []


def test_what_cannot_be_compared(store: Store) -> None:
    fill(store, name=FIRST)
    fill(store, name=SECOND)
    with pytest.raises(UsageError, match="two recordings are expected"):
        changes_of(store, FIRST, FIRST, None)
    with pytest.raises(NotFoundError, match="there is no recording 'third'; recordings: first visit, second visit"):
        changes_of(store, FIRST, "third", None)
    with pytest.raises(NotFoundError, match="has no landmarks: run semdb refine"):
        changes_of(store, FIRST, SECOND, None)
    fill(store, map_name="kitchen", name="elsewhere")
    with pytest.raises(NotFoundError, match=r"no map has both.*semdb align"):
        changes_of(store, FIRST, "elsewhere", None)
    with pytest.raises(NotFoundError, match="there is no recording"):
        changes_of(store, FIRST, SECOND, "kitchen")


def test_the_command_and_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        stored(store)

    def run(*arguments: str, code: int = 0) -> str:
        result = CliRunner().invoke(app, ["changes", *arguments])
        assert result.exit_code == code, result.output
        return result.stdout

    lines = run("--between", FIRST, SECOND).splitlines()
    assert lines[0] == "disappeared: book (landmark 3) stood at (3.00, 0.00, 0.80), score 0.90"
    assert lines[1].startswith("moved: cup (landmark 1, now 2) from (0.00, 0.00, 0.80) to (0.50, 0.00, 0.80), 0.50 m")
    assert lines[2].startswith("1 moved, 0 appeared, 1 disappeared; 1 landmarks are in both, 1 ")
    answer = json.loads(run("--map", "room", "--between", FIRST, SECOND, "--json", "--plot", "pictures"))
    assert set(answer) == {"map", "between", "counts", "changes", "landmarks"}
    assert answer["changes"][1]["after"]["crop"]["box"] is not None
    assert sorted(path.name for path in (tmp_path / "pictures").iterdir()) == ["room-changes.png", "room-crops.png"]
    run("--between", FIRST, "third", code=1)
    run("--between", FIRST, code=2)


def test_a_copy_of_a_map_knows_its_visits(store: Store, tmp_path: Path) -> None:
    map_id, _ = stored(store)
    with open_store(f"sqlite:///{tmp_path / 'copy.sqlite3'}", create=True) as copy:
        copy_map(store.engine, map_id, copy.engine, "room")
        read = "SELECT category, recording, presence, keyframes, points, seen, seen_through, x, size_z"
        query = text(f"{read} FROM landmark_visit_list ORDER BY landmark_id, recording")
        with store.engine.connect() as one, copy.engine.connect() as other:
            rows = [tuple(row) for row in one.execute(query)]
            assert [tuple(row) for row in other.execute(query)] == rows
        assert len(rows) == 10
