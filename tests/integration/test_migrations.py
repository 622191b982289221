"""The schema on every server: up from nothing, down again, up with data in it, and refused when it does not fit."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, inspect, text

import semdb.migrations
from semdb.api.finding import find
from semdb.database import schema, tokens
from semdb.database.completions import replace_completions
from semdb.database.engine import make_engine
from semdb.database.frame_views import FrameHead, FrameRow, load_frame_heads, load_frames, write_frame_views
from semdb.database.landmark_parts import LandmarkParts
from semdb.database.landmark_records import CompletedClass
from semdb.database.landmark_rows import LANDMARKS, load_gravity
from semdb.database.links import list_links
from semdb.database.pose_errors import load_pose_errors, replace_pose_errors
from semdb.database.pose_records import PoseSource, World
from semdb.database.pose_sources import recording_poses
from semdb.database.records import ChangeKind
from semdb.database.store import Store, open_store
from semdb.database.tables import metadata
from semdb.errors import SchemaError
from semdb.types import PoseErrors
from tests.database_samples import description, fill, stored_landmarks
from tests.integration.comparison import FRAMES, assert_same

VIEWS = {
    "keyframe_objects",
    "category_counts",
    "recording_summary",
    "covisible_objects",
    "keypoint_counts",
    "keyframe_links",
    "keyframe_quality",
    "landmark_list",
    "landmark_relations_named",
    "landmark_visit_list",
    "recording_pose_errors",
}


@pytest.fixture
def engine(empty_url: str) -> Engine:
    return make_engine(empty_url)


def test_revisions_are_those_of_the_scripts() -> None:
    config = Config()
    config.set_main_option("script_location", str(Path(str(semdb.migrations.__file__)).parent))
    scripts = [script.revision for script in ScriptDirectory.from_config(config).walk_revisions()]
    assert tuple(reversed(scripts)) == schema.REVISIONS


def test_up_from_nothing_and_down_to_nothing(engine: Engine) -> None:
    assert schema.current_revision(engine) is None
    for _ in range(2):
        schema.upgrade(engine)
        assert schema.current_revision(engine) == schema.HEAD
        assert set(inspect(engine).get_table_names()) == set(metadata.tables) | {"alembic_version"}
        assert set(inspect(engine).get_view_names()) == VIEWS
        schema.upgrade(engine)  # again: nothing to do
        schema.downgrade(engine)
        assert inspect(engine).get_table_names() == ["alembic_version"]
        assert inspect(engine).get_view_names() == []
        assert schema.current_revision(engine) is None


def test_statements_and_migrations_know_the_same_tables(engine: Engine) -> None:
    schema.upgrade(engine)
    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True, "compare_server_default": True})
        assert compare_metadata(context, metadata) == []


def test_a_database_with_data_is_upgraded(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, _, ids = fill(store)
    schema.downgrade(engine, "0001")
    assert schema.current_revision(engine) == "0001"
    assert "keyframe_changes" not in inspect(engine).get_table_names()
    with pytest.raises(SchemaError, match=r"revision 0001, older than this semdb needs .*semdb init"):
        open_store(empty_url)
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        # The keyframes are there, and the new change log knows of them.
        for keyframe, index in zip(store.load_keyframes(ids), FRAMES, strict=True):
            assert_same(keyframe, description(index), index)
        changes = store.changes_since(map_id, 0)
        assert [(change.keyframe_id, change.kind) for change in changes] == [(key, ChangeKind.ADDED) for key in ids]
        assert len(fill(store, name="second visit")[2]) == len(FRAMES)


def test_recordings_of_before_have_recorded_poses(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        _, recording_id, ids = fill(store)
    schema.downgrade(engine, "0007")
    assert "pose_sources" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        for keyframe, index in zip(store.load_keyframes(ids), FRAMES, strict=True):
            assert_same(keyframe, description(index), index)
        known = recording_poses(engine, recording_id)
        assert (known.source, known.world, known.upright) == (PoseSource.RECORDED, World.RECORDING, None)
        np.testing.assert_array_equal(known.map_from_recording, np.eye(4))
        assert list_links(engine) == []
        assert len(fill(store, name="second visit")[2]) == len(FRAMES)


def test_a_schema_that_is_too_new_is_left_alone(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for attempt in (
        lambda: open_store(empty_url),
        lambda: schema.upgrade(engine),
        lambda: schema.downgrade(engine),
    ):
        with pytest.raises(SchemaError, match=r"revision 9999, which this semdb does not know .*upgrade semdb"):
            attempt()
    assert schema.current_revision(engine) == "9999"
    assert "keyframes" in inspect(engine).get_table_names()


def test_no_schema_says_what_to_run(engine: Engine, empty_url: str) -> None:
    with engine.connect():  # makes the SQLite file
        pass
    with pytest.raises(SchemaError, match=r"no semdb schema in .*semdb init"):
        open_store(empty_url)


def test_a_sqlite_file_is_made_only_when_asked(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'new.sqlite3'}"
    with pytest.raises(SchemaError, match=r"no database .*new\.sqlite3"):
        open_store(url)
    assert list(tmp_path.iterdir()) == []
    with open_store(url, create=True) as store:
        assert len(fill(store)[2]) == 5
    with open_store(url) as store:
        assert store.maps()[0].keyframes == 5
    old = make_engine(url)
    schema.downgrade(old, "0001")
    old.dispose()
    with pytest.raises(SchemaError, match="older"):  # data is upgraded by `semdb init` alone
        open_store(url, create=True)


def test_processes_that_make_the_same_file_do_not_disturb_each_other(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'new.sqlite3'}"
    stores: list[Store | Exception] = []

    def work() -> None:
        try:
            stores.append(open_store(url, create=True))
        except Exception as error:
            stores.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [item for item in stores if not isinstance(item, Store)] == []
    for item in stores:
        assert isinstance(item, Store)
        item.close()


def test_a_map_of_before_gets_landmarks(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, _, ids = fill(store)
        stored_landmarks(store, map_id)
    schema.downgrade(engine, "0008")
    assert "landmarks" not in inspect(engine).get_table_names()
    assert "landmark_list" not in inspect(engine).get_view_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        for keyframe, index in zip(store.load_keyframes(ids), FRAMES, strict=True):
            assert_same(keyframe, description(index), index)
        assert load_gravity(engine, map_id) is None
        assert len(stored_landmarks(store, map_id)) == 7


def test_landmarks_of_before_get_visits(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, _, _ = fill(store)
        stored_landmarks(store, map_id)
    schema.downgrade(engine, "0009")
    assert "landmark_visits" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with engine.connect() as connection:
        assert connection.execute(text("SELECT COUNT(*) FROM landmark_visits")).scalar() == 0
        assert connection.execute(text("SELECT COUNT(*) FROM landmarks")).scalar() == 7
        query = "SELECT COUNT(*) FROM landmark_relations r JOIN landmarks l ON l.id = r.other_landmark_id "
        related = connection.execute(text(query + "WHERE r.other_category_id = l.category_id")).scalar()
        assert related == connection.execute(text("SELECT COUNT(*) FROM landmark_relations")).scalar() == 5
    with open_store(empty_url) as store:
        assert len(stored_landmarks(store, map_id)) == 7
    with engine.connect() as connection:
        assert connection.execute(text("SELECT COUNT(*) FROM landmark_visit_list")).scalar() == 7


def test_landmarks_of_before_are_of_one_class(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, _, _ = fill(store)
        stored_landmarks(store, map_id)
    schema.downgrade(engine, "0015")
    assert "landmark_categories" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        assert find(store, "vase").hits == ()
        assert len(find(store, "cup", on="dining table").hits) == 1
        stored_landmarks(store, map_id)  # computed anew
        assert len(find(store, "vase").hits) == 7


def test_keyframes_of_before_have_no_quality(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        _, _, ids = fill(store)
    schema.downgrade(engine, "0012")
    assert "keyframe_qualities" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        assert len(store.load_keyframes(ids)) == len(ids)
    with engine.begin() as connection:
        columns = "keyframe_id, sharpness, exposure, contrast, blur_px, blur_deg"
        connection.execute(text(f"INSERT INTO keyframe_qualities ({columns}) VALUES ({ids[0]}, 20, 0.5, 0.4, 0, 0)"))
        row = connection.execute(text("SELECT * FROM keyframe_quality")).one()._mapping
        assert (row["keyframe_id"], row["contrast"], row["keypoints"] > 0) == (ids[0], 0.4, True)


def test_recordings_of_before_have_no_measured_errors(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, recording_id, ids = fill(store)
    schema.downgrade(engine, "0013")
    assert "pose_errors" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        assert len(store.load_keyframes(ids)) == len(ids)
        assert load_pose_errors(engine, map_id) == {}
        errors = PoseErrors(0.008, 0.005, 90.0, 60.0, 12)
        with engine.begin() as connection:
            assert replace_pose_errors(connection, map_id, {recording_id: errors}) == 1
        assert load_pose_errors(engine, map_id) == {recording_id: errors}
        with engine.connect() as connection:
            row = connection.execute(text("SELECT * FROM recording_pose_errors")).one()._mapping
        assert (row["position_mm"], row["keyframes"]) == (pytest.approx(8.0), 12)
        assert row["rotation_deg"] == pytest.approx(0.2865, abs=1e-4)
        store.delete_recording(recording_id)
        assert load_pose_errors(engine, map_id) == {}


def test_keyframes_of_before_have_no_frames_beside_them(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, recording_id, ids = fill(store)
    schema.downgrade(engine, "0014")
    assert "frame_views" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        known = store.load_keyframes(ids)
        assert len(known) == len(ids)
        assert load_frame_heads(engine, map_id) == []
        nowhere = np.full(len(known[0].keypoints), -1, np.int32)
        keypoints = replace(known[0].keypoints, object_index=nowhere)
        head = FrameHead(ids[0], 8, np.eye(4), known[0].camera, recording_id)
        gone = replace(head, keyframe_id=max(ids) + 1000)
        assert write_frame_views(engine, recording_id, [FrameRow(one, keypoints, b"grey") for one in (head, gone)]) == 1
        [found] = load_frames(engine, load_frame_heads(engine, map_id))
        assert (found.head.frame_index, found.head.camera, found.grey) == (8, known[0].camera, b"grey")
        np.testing.assert_array_equal(found.head.keyframe_from_camera, np.eye(4))
        np.testing.assert_array_equal(found.keypoints.points, keypoints.points)
        np.testing.assert_array_equal(found.keypoints.features.descriptors, keypoints.features.descriptors)
        store.delete_recording(recording_id)
        assert load_frame_heads(engine, map_id) == []


def test_keyframes_of_before_are_as_they_were_seen(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    counts = {"chair": 2.0, "cup": 1.0}
    with open_store(empty_url) as store:
        map_id, _, ids = fill(store)
        stored_landmarks(store, map_id)
        query = store.class_query(map_id, counts)
        before = store.class_filter(map_id, query, 0.0)
        assert len(before) > 1
        computed = store.replace_refinement(map_id, LANDMARKS, store.map_state(map_id), {}, lambda *_: 7, ())
        assert computed == 7
    schema.downgrade(engine, "0016")
    assert not {"completed_categories", "map_completions"} & set(inspect(engine).get_table_names())
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        assert store.completion_of(map_id) is None  # though the step is up to date: it knew nothing of this
        assert store.class_filter(map_id, query, 0.0) == before
        with engine.connect() as connection:
            known = {str(name): int(key) for key, name in connection.execute(text("SELECT id, name FROM categories"))}
            name = connection.execute(text("SELECT MIN(c.name) FROM keyframe_categories k JOIN categories c ON "
                                           "c.id = k.category_id")).scalar()  # fmt: skip
        found = [CompletedClass(ids[0], str(name), 200, 100)]
        with engine.begin() as connection:
            replace_completions(connection, map_id, found, known)
        assert store.completion_of(map_id) == store.map_state(map_id)
    schema.downgrade(engine, "0017")
    assert "landmark_parts" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        assert store.completion_of(map_id) == store.map_state(map_id)
        parts = LandmarkParts(engine, map_id, 4)
        parts.put("box", "a name", {"centre": np.arange(3.0)})
        parts.save()
        kept = LandmarkParts(engine, map_id, 4).get("box", "a name")
        assert kept is not None
        assert kept["centre"].tolist() == [0, 1, 2]
    relations = "SELECT landmark_id, kind, other_landmark_id, score, category_id, other_category_id, map_id "
    relations += "FROM landmark_relations ORDER BY landmark_id, kind, other_landmark_id"
    with engine.connect() as connection:
        rows = connection.execute(text(relations)).all()
    assert len(rows) == 5
    assert {row.map_id for row in rows} == {map_id}
    schema.downgrade(engine, "0018")
    assert "category_id" not in {column["name"] for column in inspect(engine).get_columns("landmark_relations")}
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        with engine.connect() as connection:
            assert connection.execute(text(relations)).all() == rows  # of before, as they are written now
        assert len(find(store, "cup", on="dining table").hits) == 1
        store.delete_map(map_id)
    with engine.connect() as connection:
        for table in ("completed_categories", "map_completions", "landmark_parts"):
            assert connection.execute(text(f"SELECT COUNT(*) FROM {table}")).scalar() == 0


def test_upgrades_that_were_cut_off_go_on(engine: Engine) -> None:
    schema.upgrade(engine)
    for revision, cut in (
        ("0015", ""),
        ("0016", "DROP TABLE map_completions"),
        ("0016", ""),
        ("0017", ""),
        ("0018", ""),
    ):
        with engine.begin() as connection:
            connection.execute(text(f"UPDATE alembic_version SET version_num = '{revision}'"))
            if cut:
                connection.execute(text(cut))
        schema.upgrade(engine)
        assert schema.current_revision(engine) == schema.HEAD
        with engine.connect() as connection:
            assert compare_metadata(MigrationContext.configure(connection), metadata) == []
    with engine.begin() as connection:  # a downgrade that was cut off
        connection.execute(text("DROP INDEX ix_landmark_relations_pair"
                                f"{'' if engine.dialect.name == 'sqlite' else ' ON landmark_relations'}"))  # fmt: skip
        connection.execute(text("ALTER TABLE landmark_relations DROP COLUMN map_id"))
    schema.downgrade(engine, "0018")
    assert not {"category_id", "map_id"} & {one["name"] for one in inspect(engine).get_columns("landmark_relations")}


def test_a_database_of_before_gets_tokens(engine: Engine, empty_url: str) -> None:
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        map_id, _, ids = fill(store)
    schema.downgrade(engine, "0010")
    assert "access_tokens" not in inspect(engine).get_table_names()
    schema.upgrade(engine)
    with open_store(empty_url) as store:
        for keyframe, index in zip(store.load_keyframes(ids), FRAMES, strict=True):
            assert_same(keyframe, description(index), index)
        _, secret = tokens.make_token(engine, "robot", "localize", map_id)
        found, _ = tokens.find_token(engine, secret)
        assert (found.role, found.map_id) == ("localize", map_id)
        assert tokens.find_token(engine, secret.lower()) == (None, True)
        store.delete_map(map_id)
        assert tokens.find_token(engine, secret) == (None, False)
