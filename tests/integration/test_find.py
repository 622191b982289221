"""`semdb find` on every server: one statement, what words mean, and what is said where nothing is found."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text
from typer.testing import CliRunner

from semdb.api.finding import find
from semdb.cli.main import app
from semdb.database.landmark_search import Wanted, as_text, statement
from semdb.database.store import Store, open_store
from semdb.errors import UsageError
from semdb.exchange.formats import export_map
from semdb.exchange.ply import EDGES, VERTEX
from semdb.exchange.source import ExportOptions
from semdb.landmarks.words import understand
from tests.database_samples import fill, stored_landmarks
from tests.query_plans import checked_plans

CLASSES = ("chair", "cup", "dining table", "sink", "book", "banana")


@pytest.fixture
def landmarks(store: Store) -> list[int]:
    """A table 0 with a cup 1 and a banana 5 on it and a chair 2 beside it, a sink 3 with a cup 4, a book 6."""
    map_id, _, _ = fill(store)
    return stored_landmarks(store, map_id)


def found(store: Store, what: str, **asked: Any) -> list[int]:
    return [hit.landmark_id for hit in find(store, what, **asked).hits]


def test_by_class_and_by_what_is_near_or_below(store: Store, landmarks: list[int]) -> None:
    table, cup, chair, sink, other_cup, banana, _ = landmarks
    assert found(store, "cup") == [cup, other_cup]
    assert found(store, "mug", near="sink") == [other_cup]
    assert found(store, "cup", on="table") == [cup]
    assert found(store, "cup", not_near="sink") == [cup]
    assert found(store, "something to sit on", near="table") == [chair]
    assert found(store, "fruit", map="room") == [banana]
    assert found(store, "cup", origin=(-2, 0, 1), limit=1) == [other_cup]
    assert found(store, "cup", origin=(2, 1, 1), limit=1) == [cup]
    assert found(store, "furniture") == [table, chair]
    assert found(store, "appliances") == [sink]


def test_a_hit_has_all_that_is_known(store: Store, landmarks: list[int]) -> None:
    answer = find(store, "cup", near="sink", origin=(-1.8, 0.3, 4.95))
    (hit,) = answer.hits
    assert hit.parts == pytest.approx({"class": 0.97, "near": 0.8, "state": 1.0, "distance": 25 / 41})
    assert hit.score == pytest.approx(0.97 * 0.8 * 25 / 41)
    assert hit.distance == pytest.approx(4)
    assert hit.position == pytest.approx((-1.8, 0.3, 0.95))
    assert hit.covariance == pytest.approx(np.eye(3) * 1e-4)
    assert hit.viewpoint is not None
    assert hit.viewpoint.distance == 1.5
    assert hit.viewpoint.keyframe_id == hit.evidence[0].keyframe_id
    assert hit.viewpoint.world_from_camera.shape == (4, 4)
    assert answer.understood["near"] == {"said": "sink", "classes": ["sink"], "how": "class"}
    assert answer.missing is None
    with store.engine.connect() as connection:  # what --sql prints is what was asked
        assert [row.landmark_id for row in connection.execute(text(answer.sql.replace(":", "\\:")))] == [landmarks[4]]
    json.dumps(answer.as_dict())


def test_what_is_rather_something_else_comes_last(store: Store) -> None:
    """Every landmark may be a vase, at 0.03: a search for one finds them, and things near them, as much later."""
    map_id, _, _ = fill(store)
    table, cup, chair, *_, banana, _ = stored_landmarks(store, map_id)
    hits = find(store, "vase", on="table").hits
    assert [hit.landmark_id for hit in hits] == [cup, banana]
    assert hits[0].parts == pytest.approx({"class": 0.03, "on": 0.98, "state": 1.0})
    assert hits[0].category == "cup"
    near = find(store, "chair", near="vase").hits
    assert [hit.landmark_id for hit in near] == [chair]
    assert near[0].parts["near"] == pytest.approx(0.9 * 0.03)
    assert found(store, "furniture") == [table, chair]
    assert found(store, "crockery", on="vase") == [cup]
    with store.engine.begin() as connection:
        query = "UPDATE landmark_categories SET category_id = (SELECT id FROM categories WHERE name = 'chair')"
        connection.execute(text(f"{query} WHERE landmark_id = {cup}"))
    assert found(store, "chair") == [chair]  # in all maps, where something is most likely so
    assert found(store, "chair", map="room") == [chair, cup]
    store.delete_map(map_id)
    with store.engine.connect() as connection:
        assert connection.execute(text("SELECT COUNT(*) FROM landmark_categories")).scalar() == 0


def test_when_it_was_seen(store: Store, landmarks: list[int]) -> None:
    _, cup, _, _, other_cup, *_ = landmarks
    assert found(store, "cup", seen_after=9 * 10**9) == [other_cup]
    assert found(store, "cup", seen_after="first visit") == [cup, other_cup]
    answer = find(store, "cup", seen_after="2030-01-01T00:00")
    assert answer.missing is not None
    assert answer.missing.reason == "not_looked_at"
    assert [item["landmark"] for item in answer.missing.candidates] == [other_cup, cup]
    with pytest.raises(UsageError, match="neither a time"):
        find(store, "cup", seen_after="yesterday")


def test_a_miss_says_which_of_three_it_is(store: Store, landmarks: list[int]) -> None:
    def reason(what: str, **asked: Any) -> str | None:
        missing = find(store, what, **asked).missing
        return None if missing is None else missing.reason

    assert reason("cup") is None
    assert reason("toaster") == "never_seen"
    assert reason("cup", near="toaster") == "not_looked_at"
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE landmarks SET state = 'gone' WHERE id = :key"), {"key": landmarks[6]})
    assert reason("book") == "gone"
    usual = find(store, "cup", near="book").missing
    assert usual is not None
    assert usual.usual == ({"relation": "on", "category": "dining table", "count": 1},)


def test_a_miss_is_told_beside_what_is_rather_something_else(store: Store) -> None:
    """Every landmark may be a vase, at 0.03: that hides neither that none was seen, nor that one is gone."""
    map_id, _, _ = fill(store)
    table, cup, *_ = stored_landmarks(store, map_id)

    def told(what: str, **asked: Any) -> tuple[list[int], str | None]:
        answer = find(store, what, **asked)
        return [hit.landmark_id for hit in answer.hits], None if answer.missing is None else answer.missing.text

    but = "; what was found is rather something else, or near that"
    hits, text_of = told("vase", map="room")
    assert (len(hits), text_of) == (7, f"vase: never seen{but}")
    near, text_of = told("chair", near="vase")
    assert (len(near), text_of) == (1, f"no vase was seen, so no place near one was looked at{but}")
    assert told("cup", on="table") == ([cup], None)
    with store.engine.begin() as connection:
        vase = "(SELECT id FROM categories WHERE name = 'vase')"
        connection.execute(text(f"UPDATE objects SET category_id = {vase} WHERE id = (SELECT MIN(object_id) FROM "
                                "landmark_sightings)"))  # fmt: skip
    _, text_of = told("vase", map="room")
    assert text_of == f"vase: never seen (1 objects were called so, of landmarks that are rather something else){but}"
    with store.engine.begin() as connection:
        connection.execute(text(f"UPDATE landmarks SET state = 'gone', category_id = {vase} WHERE id = {table}"))
    hits, text_of = told("vase", map="room")
    assert (len(hits), text_of) == (6, f"vase: was seen, and later keyframes see through its place{but}")


def test_what_is_said_of_hits_that_are_cut_off_or_beside_something_else(tmp_path: Path) -> None:
    with open_store(f"sqlite:///{tmp_path}/m.sqlite3", create=True) as store:
        map_id, _, _ = fill(store)
        _, cup, chair, _, other_cup, banana, book = stored_landmarks(store, map_id)
        with store.engine.begin() as connection:
            query = "UPDATE landmark_categories SET probability = 0.9, category_id = (SELECT id FROM categories "
            connection.execute(text(f"{query} WHERE name = 'cup') WHERE landmark_id = {banana}"))
            connection.execute(text(f"UPDATE landmarks SET state = 'tentative' WHERE id IN ({cup}, {other_cup})"))
        for limit in (1, 2):
            answer = find(store, "cup", map="room", limit=limit)
            assert [hit.landmark_id for hit in answer.hits] == [banana, cup][:limit]
            assert answer.missing is None
        placed = find(store, "cup", map="room", near="book", limit=1).missing
        assert placed is not None
        assert placed.text == "cup: seen, but never so placed"
        with store.engine.begin() as connection:  # there is a vase, and the chair is near a table that may be one
            vase = "(SELECT id FROM categories WHERE name = 'vase')"
            connection.execute(text(f"UPDATE landmarks SET category_id = {vase} WHERE id = {book}"))
        beside = find(store, "chair", map="room", near="vase")
        assert [hit.landmark_id for hit in beside.hits] == [chair]
        assert beside.missing is not None
        assert beside.missing.text.startswith("chair: seen, but never so placed; what was found is rather something")


def test_how_likely_a_thing_is_of_several_classes_depends_on_no_ids(store: Store) -> None:
    map_id, _, _ = fill(store)
    first = stored_landmarks(store, map_id)[0]
    classes = ("vase", "keyboard", "kite")
    with store.engine.begin() as connection:
        for name in classes:
            connection.execute(text("INSERT INTO categories (name) SELECT :name WHERE NOT EXISTS (SELECT 1 FROM "
                                    "categories WHERE name = :name)"), {"name": name})  # fmt: skip
        connection.execute(text("DELETE FROM landmark_categories"))
    shares, found = (0.1, 0.2, 0.3), []
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):  # 0.1 + 0.2 + 0.3 is another number than 0.3 + 0.2 + 0.1
        with store.engine.begin() as connection:
            connection.execute(text("DELETE FROM landmark_categories"))
            for name, k in zip(classes, order, strict=True):
                query = "INSERT INTO landmark_categories SELECT id, :map, :landmark, :share FROM categories WHERE "
                values = {"map": map_id, "landmark": first, "share": shares[k], "name": name}
                connection.execute(text(f"{query} name = :name"), values)
        wanted = Wanted(classes, map_id=map_id, perhaps=True)
        with store.engine.connect() as connection:
            found.append([row.class_score for row in connection.execute(statement(wanted))])
    assert found == [[0.6]] * 3


def test_no_table_is_read_from_end_to_end(store: Store, landmarks: list[int]) -> None:
    with store.engine.begin() as connection:
        columns = "probability, evidence, x, y, z, cov_xx, cov_xy, cov_xz, cov_yy, cov_yz, cov_zz, size_x, size_y, "
        columns += "size_z, yaw, sightings, keyframes, missed, seen_through, state"
        query = f"INSERT INTO landmarks (map_id, category_id, {columns}) SELECT map_id, category_id, {columns} "
        for _ in range(8):  # chairs, so that a class is a small part
            connection.execute(
                text(query + "FROM landmarks WHERE category_id = (SELECT id FROM categories WHERE name = 'chair')")
            )
        if store.engine.dialect.name != "sqlite":
            connection.execute(text("ANALYZE TABLE landmarks"))
    wanted = Wanted(("cup",), near=("sink",), map_id=1, origin=(0.0, 0.0, 0.0))
    with checked_plans() as check, store.engine.connect() as connection:
        for one in (wanted, replace(wanted, perhaps=True)):
            assert len(connection.execute(statement(one)).all()) == 1
    assert [scan for scan in check.full_scans if "landmarks" in scan.split("\n")[0]] == []


def test_what_of_one_class_stands_near_another_is_one_range_of_an_index(tmp_path: Path) -> None:
    wanted = Wanted(("cup",), near=("sink",), map_id=1, perhaps=True)
    with open_store(f"sqlite:///{tmp_path}/m.sqlite3", create=True) as store, store.engine.connect() as connection:
        plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {as_text(store.engine, wanted)}").all()
    related, things = (
        [row[-1] for row in plan if f"SEARCH {name} " in row[-1]] for name in ("landmark_relations", "landmarks")
    )
    assert len(related) == 3  # of these classes, of what may be of the one, to what may be of the other
    assert all("USING COVERING INDEX" in line for line in related)
    assert sum("pair (category_id=? AND other_category_id=? AND map_id=?" in line for line in related) == 1
    assert all(line.endswith("(rowid=?)") for line in things)  # however many of a class there are


@pytest.mark.parametrize(
    ("said", "classes", "how"),
    [
        ("Cups", ("cup",), "class"),
        ("a sofa", ("couch",), "synonym"),
        ("drink from", ("cup", "wine glass", "bottle"), "use"),
        ("heat-food", ("microwave", "oven", "toaster"), "use"),
        ("something to eat", understand("food", ()).classes, "kind"),
        ("knives", ("knife",), "class"),
    ],
)
def test_words(said: str, classes: tuple[str, ...], how: str) -> None:
    understood = understand(said, CLASSES)
    assert (understood.classes, understood.how) == (classes, how)


def test_a_word_that_means_nothing(store: Store, landmarks: list[int]) -> None:
    with pytest.raises(UsageError, match=r"'chiar' is no class of this database.*did you mean chair"):
        find(store, "chiar")
    with pytest.raises(UsageError, match="three numbers"):
        find(store, "cup", origin=(1.0, 2.0))


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        map_id, _, _ = fill(store)
        stored_landmarks(store, map_id)

    def run(*arguments: str, code: int = 0) -> str:
        result = CliRunner().invoke(app, ["find", *arguments])
        assert result.exit_code == code, result.output
        return result.stdout

    shown = run("mug", "--on", "table", "--from", "0,0,0")
    assert "what: mug = cup" in shown
    assert "landmark 2: cup 0.97 at (2.20, 1.10, 0.82) in room, confirmed" in shown
    answer = json.loads(run("cup", "--near", "sink", "--json"))
    assert set(answer) == {"understood", "hits", "missing"}
    assert answer["hits"][0]["landmark"] == 5
    missing = json.loads(run("toaster", "--json", code=1))
    assert (missing["hits"], missing["missing"]["reason"]) == ([], "never_seen")
    assert run("cup", "--sql").startswith("SELECT ")
    run("cup", "--from", "here", code=2)
    run("cup", "--plot", "pictures")
    assert [path.name for path in (tmp_path / "pictures").iterdir()] == ["room-landmarks.png"]


def test_exports(store: Store, landmarks: list[int], tmp_path: Path) -> None:
    assert export_map(store, "landmarks", "room", tmp_path / "t.csv") == "7 landmarks"
    lines = (tmp_path / "t.csv").read_text().splitlines()
    assert len(lines) == 8
    assert lines[1].startswith(f"{landmarks[0]},dining table,0.97,2.0,1.0,0.4,1.6,")
    export_map(store, "landmarks", "room", tmp_path / "t.json")
    whole = json.loads((tmp_path / "t.json").read_text())
    assert (len(whole["landmarks"]), len(whole["relations"]), whole["floor"]) == (7, 5, 0.0)
    export_map(store, "landmarks", "room", tmp_path / "t.geojson")
    features = json.loads((tmp_path / "t.geojson").read_text())["features"]
    ring = np.array(features[0]["geometry"]["coordinates"][0])
    assert ring.shape == (5, 3)
    assert ring[0] == pytest.approx(ring[4])
    assert np.linalg.norm(ring[1] - ring[0]) == pytest.approx(1.6)
    assert ring[:, 2] == pytest.approx(0.4 - 0.75 / 2)
    with pytest.raises(UsageError, match=r"\.csv, \.json or \.geojson"):
        export_map(store, "landmarks", "room", tmp_path / "t.xml")
    assert VERTEX.itemsize == 15
    assert EDGES.shape == (12, 2)
    assert not ExportOptions().landmarks
