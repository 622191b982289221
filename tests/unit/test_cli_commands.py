"""Commands on a small database of made-up keyframes."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database import schema
from semdb.database.store import open_store
from semdb.recordings import DroppedFrame
from semdb.recordings.dropped import group_dropped
from tests.database_samples import fill, plan
from tests.unit.onnx_files import write_constant_model
from tests.unit.recording_miniatures import write_tum


@pytest.fixture(autouse=True)
def _empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in [name for name in os.environ if name.startswith("SEMDB_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("SEMDB_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def keyframes() -> list[int]:
    """A map "room" with the recordings "first visit" and "second visit"; the ids of the first one's keyframes."""
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        _, _, ids = fill(store)
        fill(store, name="second visit", frame_indexes=(1, 2), seed=50)
    return ids


def run(*arguments: str, code: int = 0) -> Any:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == code, f"{result.exit_code}: {result.output}{result.exception!r}"
    return result


def stored() -> dict[str, int]:
    """Keyframes of each recording, by the status command."""
    return {entry["recording"]: entry["keyframes"] for entry in json.loads(run("status", "--json").stdout)}


def test_init_creates_then_says_it_is_up_to_date(tmp_path: Path) -> None:
    assert run("init").stdout == f"created the schema, revision {schema.HEAD}, in sqlite:///semdb.sqlite3\n"
    assert "up to date" in run("init").stdout
    assert "created" in run("init", "--database-url", "sqlite:///other.sqlite3").stdout
    assert (tmp_path / "other.sqlite3").is_file()


def test_a_recording_without_poses_names_the_commands_that_find_them(tmp_path: Path) -> None:
    walk = write_tum(tmp_path / "walk", n=3)
    assert "trajectory   0." in run("recording", str(walk), "--quick").stdout
    (walk / "groundtruth.txt").unlink()
    assert (
        "trajectory   no poses: `semdb ingest` estimates them from images and depth, `semdb trajectory` alone, too"
        in run("recording", str(walk), "--quick").stdout
    )


def test_a_picture_as_the_folder_for_pictures_is_refused(tmp_path: Path) -> None:
    assert "--plot out.png: is the name of a picture" in run("localize", "a.png", "--plot", "out.png", code=2).stderr
    assert not (tmp_path / "out.png").exists()


def test_init_upgrades_an_older_schema() -> None:
    from semdb.database.engine import make_engine

    engine = make_engine("sqlite:///semdb.sqlite3")
    schema.upgrade(engine, schema.REVISIONS[0])
    engine.dispose()
    assert "older than this semdb needs" in run("status", code=1).stderr
    assert f"from revision {schema.REVISIONS[0]} to {schema.HEAD}" in run("init").stdout
    assert run("status").stdout.endswith("no recordings yet: semdb ingest PATH\n")


def test_commands_say_that_there_is_no_database() -> None:
    for arguments in (["status"], ["retry"], ["keypoints", "1"], ["delete", "map", "room", "--yes"]):
        result = run(*arguments, code=1)
        assert result.stderr.startswith("semdb: there is no database sqlite:///semdb.sqlite3")
        assert result.stderr.count("\n") == 1


def test_a_server_that_does_not_answer() -> None:
    result = run("status", "--database-url", "mysql+pymysql://ann:secret@127.0.0.1:9/semdb", code=1)
    assert "does not answer" in result.stderr
    assert "secret" not in result.stderr


@pytest.mark.usefixtures("keyframes")
def test_status_table_and_json() -> None:
    lines = run("status").stdout.splitlines()
    assert lines[0] == "database: sqlite:///semdb.sqlite3"
    assert lines[3].split()[:5] == ["1", "room", "first", "visit", "tum"]
    assert stored() == {"first visit": 5, "second visit": 2}
    assert json.loads(run("status", "--map", "room", "--json").stdout)[0]["items"] == {"done": 5}
    assert "there is no map 'hall'" in run("status", "--map", "hall", code=1).stderr


def test_watch_ends_when_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    looks = 0

    def finish(_seconds: float) -> None:
        nonlocal looks
        looks += 1
        with open_store("sqlite:///semdb.sqlite3") as store:
            fill(store, name="slow", frame_indexes=(4, 9))

    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        from tests.database_samples import MODELS

        store.plan_recording(store.ensure_map("room"), plan("slow", (4, 9)), MODELS)
    monkeypatch.setattr("semdb.cli.status.time.sleep", finish)
    output = run("status", "--watch").stdout
    assert looks == 1
    assert output.count("slow") == 2
    assert output.splitlines()[-1].split()[4:7] == ["complete", "2", "2"]


@pytest.mark.usefixtures("keyframes")
def test_watch_does_not_wait_for_what_is_being_deleted() -> None:
    from sqlalchemy import update

    from semdb.database.tables import recordings

    with open_store("sqlite:///semdb.sqlite3") as store, store.engine.begin() as connection:
        connection.execute(update(recordings).where(recordings.c.name == "first visit").values(state="deleting"))
    output = run("status", "--watch").stdout
    assert output.count("first visit") == 1
    assert "deleting" in output


def test_resume_takes_no_path() -> None:
    assert "--resume is of all recordings and takes no PATH" in run("ingest", "room", "--resume", code=2).stderr
    assert "takes no --map, --stride: leave" in run("ingest", "--map", "m", "--stride", "0", "--resume", code=2).stderr


def test_retry_puts_failed_keyframes_back() -> None:
    from tests.database_samples import MODELS

    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        planned = store.plan_recording(store.ensure_map("room"), plan("broken", (4, 9)), MODELS)
        store.fail_item(planned.recording_id, 4, "rgb/4.png: the file ends too early")
        store.fail_item(planned.recording_id, 9, "rgb/9.png: not an image")
        assert store.finish_recording(planned.recording_id) == "complete"
    assert "failed: broken frame 4, attempt 1: rgb/4.png: the file ends too early" in run("status").stdout

    printed = run("retry").stdout
    assert printed.startswith("room/broken: 2 put back; run: semdb ingest recordings/broken --map room --name broken\n")
    (entry,) = json.loads(run("status", "--json").stdout)
    assert entry["items"] == {"pending": 2}
    assert entry["state"] == "ingesting"
    assert entry["failed"] == []
    assert run("retry").stdout == "nothing has failed\n"


@pytest.mark.usefixtures("keyframes")
def test_delete_asks_where_somebody_can_answer() -> None:
    result = run("delete", "recording", "first visit", code=2)
    assert result.stderr.startswith("semdb: Delete the recording room/first visit with 5 keyframes?")
    assert "--yes" in result.stderr
    assert stored() == {"first visit": 5, "second visit": 2}


def test_delete_keyframes_recording_and_map(keyframes: list[int]) -> None:
    assert run("delete", "keyframes", *map(str, keyframes[:2]), "--yes").stdout == "deleted 2 keyframes\n"
    assert stored() == {"first visit": 3, "second visit": 2}
    assert f"no keyframe {keyframes[0]}" in run("delete", "keyframes", str(keyframes[0]), "--yes", code=1).stderr

    output = run("delete", "recording", "first visit", "--yes").stdout
    assert output == "deleted the recording room/first visit: 3 keyframes\n"
    assert "recordings: second visit" in run("delete", "recording", "first visit", "--yes", code=1).stderr

    assert run("delete", "map", "room", "--yes").stdout == "deleted the map room: 1 recordings, 2 keyframes\n"
    assert stored() == {}


@pytest.mark.usefixtures("keyframes")
def test_delete_wants_to_know_which_of_two() -> None:
    with open_store("sqlite:///semdb.sqlite3") as store:
        fill(store, map_name="hall")
    assert "say which with --map" in run("delete", "recording", "first visit", "--yes", code=2).stderr
    assert "hall/first visit" in run("delete", "recording", "first visit", "--map", "hall", "--yes").stdout
    with open_store("sqlite:///semdb.sqlite3") as store:
        assert [(info.name, info.keyframes) for info in store.maps()] == [("room", 7), ("hall", 0)]


def test_keypoints_are_those_stored(keyframes: list[int]) -> None:
    with open_store("sqlite:///semdb.sqlite3") as store:
        (expected,) = store.load_keyframes(keyframes[1:2])
    rows = list(csv.DictReader(io.StringIO(run("keypoints", str(keyframes[1]), "--csv").stdout)))
    assert len(rows) == len(expected.keypoints) == 60
    ordinals = [int(row["object"]) if row["object"] else -1 for row in rows]
    np.testing.assert_array_equal(ordinals, expected.keypoints.object_index)
    xy = np.array([[float(row["x"]), float(row["y"])] for row in rows], dtype=np.float32)
    np.testing.assert_array_equal(xy, expected.keypoints.features.xy)
    points = np.array([[float(row[axis]) if row[axis] else np.nan for axis in "XYZ"] for row in rows], np.float32)
    np.testing.assert_array_equal(points, expected.keypoints.points)
    categories = {stored.ordinal: stored.category for stored in expected.objects}
    assert all(row["category"] == categories.get(ordinal, "") for row, ordinal in zip(rows, ordinals, strict=True))
    assert len(run("keypoints", str(keyframes[1])).stdout.splitlines()) == 62
    assert "there is no keyframe 999" in run("keypoints", "999", code=1).stderr


def test_models_list() -> None:
    assert "no database yet" in run("models", "list").stdout
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        fill(store)
    listed = json.loads(run("models", "list", "--json", "--encoder", "gist").stdout)
    assert listed["settings"] == {"detector": "auto", "encoder": "gist", "features": "auto"}
    assert [(model["map"], model["role"], model["name"]) for model in listed["maps"]] == [
        ("room", "detector", "recorded"),
        ("room", "encoder", "gist"),
        ("room", "features", "surf"),
    ]


def test_models_list_says_whose_rows_a_file_made(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "cache" / "models"
    folder.mkdir(parents=True)
    for name, embedding in (("places.onnx", [[1, 2]]), ("other.onnx", [[2, 1]])):
        write_constant_model(folder / name, {"embedding": np.array(embedding, np.float32)}, {"licence": "MIT"})
    for map_name in ("kitchen", "hall"):
        run("ingest", str(room), "--keyframes", "3", "--map", map_name, "--encoder", "onnx:places.onnx")
    listed = json.loads(run("models", "list", "--json").stdout)
    files = {file["file"]: file for file in listed["files"]}
    sha256 = hashlib.sha256((folder / "places.onnx").read_bytes()).hexdigest()
    assert (files["places.onnx"]["sha256"], files["places.onnx"]["licence"]) == (sha256, "MIT")
    assert files["places.onnx"]["maps"] == ["hall", "kitchen"]
    assert files["other.onnx"]["maps"] == []
    assert {m["sha256"] for m in listed["maps"] if m["role"] == "encoder"} == {sha256}
    [line] = [line for line in run("models", "list").stdout.splitlines() if line.startswith("places.onnx")]
    assert line.split() == ["places.onnx", "onnx:places.onnx", "yes", sha256[:12], "MIT", "hall,", "kitchen"]


def test_every_listed_spec_is_known_to_its_loader() -> None:
    from semdb.cli.models import SPECS
    from semdb.errors import ModelError
    from semdb.perception.detectors import load_detector
    from semdb.perception.encoders import load_encoder
    from semdb.perception.features import load_features
    from semdb.perception.matchers import load_matcher
    from semdb.settings import Settings

    loaders: dict[str, Any] = {
        "detector": load_detector,
        "encoder": load_encoder,
        "features": load_features,
        "matcher": load_matcher,
    }
    for role, spec, needs_file, _ in SPECS:
        if needs_file:
            with pytest.raises(ModelError, match="no model file at"):
                loaders[role](spec.replace("FILE", "missing.onnx"), Settings())
        else:
            assert loaders[role](spec, Settings()).info.role == role


def test_doctor_is_content_with_a_new_installation(keyframes: list[int]) -> None:
    checks = {check["what"]: check for check in json.loads(run("doctor", "--json").stdout)}
    assert {check["state"] for check in checks.values()} <= {"ok", "info"}
    assert checks["schema"]["text"] == f"revision {schema.HEAD}"
    assert checks["numpy"]["text"] == np.__version__


def test_doctor_names_problems() -> None:
    (Path("semdb.sqlite3")).write_text("this is no database, but long enough to look at" * 20)
    result = run("doctor", "--detector", "onnx:missing.onnx", "--features", "brief", code=1)
    problems = {line.split()[1]: line for line in result.stdout.splitlines() if line.startswith("problem")}
    assert set(problems) == {"database", "detector", "features"}
    assert "is not a database" in problems["database"]
    assert "missing.onnx" in problems["detector"]
    assert result.stderr == "semdb: 3 problems found\n"


def test_synth_then_recording() -> None:
    size = ["--frames", "3", "--width", "64", "--height", "48"]
    assert run("synth", "room", *size).stdout == "wrote 3 frames of 64x48 to room\n"
    assert "is not empty" in run("synth", "room", *size, code=2).stderr
    assert "frames = 0 is outside" in run("synth", "other", "--frames", "0", code=2).stderr

    broken = sorted(Path("room/rgb").iterdir())[1]
    content = broken.read_bytes()
    broken.write_bytes(content[: len(content) // 2] + bytes(len(content) // 2 - 12) + content[-12:])
    (seen,) = json.loads(run("recording", "room", "--json").stdout)
    assert (seen["format"], seen["frames"], seen["usable"], seen["triples"]) == ("synthetic", 3, 2, 2)
    assert [dropped["name"] for dropped in seen["dropped"]] == [f"rgb/{broken.name}"]
    assert seen["camera"]["width"] == 64
    assert 0 < seen["trajectory_length_m"] < 2

    text = run("recording", "room").stdout
    assert "3, usable 2 (2 with colour, depth and pose)" in text
    assert broken.name in text
    quick = run("recording", "room", "--quick").stdout
    assert "usable 3" in quick


def test_recording_says_what_is_wrong() -> None:
    assert run("recording", "nowhere", code=1).stderr == "semdb: nowhere: no such folder or file\n"
    Path("empty").mkdir()
    assert "the folder is empty" in run("recording", "empty", code=1).stderr
    assert "--camera" in run("recording", "empty", "--camera", "1,2", code=2).stderr


def test_dropped_frames_are_grouped_by_reason() -> None:
    dropped = [DroppedFrame(f"rgb/{i}.png", f"rgb/{i}.png: no depth within 20 ms (nearest {i} ms)") for i in range(5)]
    lines = group_dropped([*dropped, DroppedFrame("rgb/9.png", "pose is not a number")])
    assert lines == [
        "5 x rgb/0.png: no depth within 20 ms (nearest 0 ms): rgb/0.png, rgb/1.png, rgb/2.png and 2 more",
        "1 x pose is not a number: rgb/9.png",
    ]


@pytest.mark.usefixtures("keyframes")
def test_sql_in_three_formats() -> None:
    query = "SELECT recording, COUNT(*) AS n FROM keyframe_objects GROUP BY recording ORDER BY recording"
    rows = json.loads(run("sql", query, "--format", "json").stdout)
    assert [row["recording"] for row in rows] == ["first visit", "second visit"]
    assert all(row["n"] > 0 for row in rows)
    lines = run("sql", query, "--format", "csv").stdout.splitlines()
    assert lines == ["recording,n", *(f"{row['recording']},{row['n']}" for row in rows)]
    assert run("sql", query).stdout.splitlines()[2].split() == ["first", "visit", str(rows[0]["n"])]


@pytest.mark.usefixtures("keyframes")
def test_sql_only_reads() -> None:
    assert run("sql", "DELETE FROM keyframes", code=2).stderr.startswith("semdb: only queries can be run here")
    assert "refused" in run("sql", "WITH one AS (SELECT 1) DELETE FROM keyframes", code=1).stderr
    assert "no such column" in run("sql", "SELECT missing_column FROM keyframes", code=1).stderr
    assert run("sql", "SELECT 1", "--format", "xml", code=2).exit_code == 2
    assert stored() == {"first visit": 5, "second visit": 2}


def test_sql_on_a_server_needs_a_reader() -> None:
    result = run("sql", "SELECT 1", "--database-url", "mysql+pymysql://ann:secret@127.0.0.1:9/semdb", code=2)
    assert "SEMDB_READER_URL" in result.stderr


def test_sql_on_a_server_that_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    server = "mysql+pymysql://ann:secret@127.0.0.1:9/semdb"
    monkeypatch.setenv("SEMDB_READER_URL", server)
    result = run("sql", "SELECT 1", "--database-url", server, code=1)
    assert "does not answer" in result.stderr
    assert "SEMDB_READER_URL" in result.stderr
    assert "secret" not in result.stderr


def test_accounts_are_printed_as_sql() -> None:
    output = run("init", "--accounts", "--database-url", "mysql+pymysql://root:known.to.nobody@127.0.0.1:9/maps").stdout
    statements = [line for line in output.splitlines() if not line.startswith("-- ")]
    assert statements[0].startswith("CREATE DATABASE IF NOT EXISTS `maps`")
    assert [line.split("'")[1] for line in statements if line.startswith("CREATE USER")] == [
        "maps_owner",
        "maps_writer",
        "maps_reader",
    ]
    assert "GRANT CREATE, SELECT, SHOW VIEW ON `maps`.`keyframes` TO 'maps_reader'@'%';" in statements
    urls = {line.split()[1]: line.split()[-1] for line in output.splitlines() if line.startswith("-- ")}
    assert set(urls) == {"owner", "writer", "reader"}
    assert urls["reader"].startswith("mysql+pymysql://maps_reader:")
    assert "known.to.nobody" not in output  # with a character that no generated password has

    assert "SQLite has no accounts" in run("init", "--accounts", code=2).stderr
    assert "--execute goes with --accounts" in run("init", "--execute", code=2).stderr
    assert "--rotate goes with --accounts" in run("init", "--rotate", code=2).stderr
    assert "--grants goes with --accounts" in run("init", "--grants", code=2).stderr
    assert "one after the other" in run("init", "--reader", "--grants", "--rotate", code=2).stderr


def test_new_passwords_are_printed_as_sql() -> None:
    """No right and no schema is made again."""
    arguments = ("init", "--accounts", "--rotate", "--database-url", "mysql+pymysql://root:x@127.0.0.1:9/maps")
    lines = run(*arguments).stdout.splitlines()
    assert [line.split()[:3] for line in lines[:3]] == [
        ["ALTER", "USER", f"'maps_{role}'@'%'"] for role in ("owner", "writer", "reader")
    ]
    assert all(line.startswith("-- ") for line in lines[3:])
