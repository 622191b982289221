"""`semdb localize` and `semdb evaluate` as a person runs them, on a rendered room; bad input among it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb import open as semdb_open
from semdb.geometry import pose_error, pose_from, rotation_from_quat_wxyz
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings import open_recording
from semdb.settings import Settings
from tests.rooms import semdb, semdb_json


@pytest.fixture(scope="module")
def url(room: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A database with the room, every third frame a keyframe."""
    made = f"sqlite:///{tmp_path_factory.mktemp('localize') / 'semdb.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    ingest_recordings([room], settings, IngestOptions(stride=3, map_name="room"))
    return made


@pytest.fixture(scope="module")
def images(room: Path) -> list[Path]:
    return sorted((room / "rgb").iterdir())


def true_pose(room: Path, image: Path) -> np.ndarray:
    entries = {entry.image_path.name: entry for entry in open_recording(room).entries}
    pose = entries[image.name].world_from_camera
    assert pose is not None
    return pose


@pytest.mark.parametrize("coarse", ["sql", "index"])
def test_images_become_poses(room: Path, url: str, images: list[Path], tmp_path: Path, coarse: str) -> None:
    asked = [images[4], images[13]]
    answers = semdb_json("localize", *asked, "--json", "--coarse", coarse, "--plot", tmp_path / "plots", url=url)
    assert [Path(answer["image"]) for answer in answers] == asked
    for answer, image in zip(answers, asked, strict=True):
        assert answer["verdict"] == "localized"
        assert answer["map"] == "room"
        pose = pose_from(rotation_from_quat_wxyz(answer["pose"]["quat_wxyz"]), answer["pose"]["position"])
        metres, degrees = pose_error(pose, true_pose(room, image))
        assert metres < 0.02
        assert degrees < 0.5
        covariance = np.array(answer["covariance"])
        assert covariance.shape == (6, 6)
        assert np.sqrt(np.trace(covariance[:3, :3])) < 0.05
        assert answer["inliers"] >= 14
        assert 0.5 < answer["confidence"] <= 1
        assert answer["refinements"] == {"points": "none"}
        best = max(answer["candidates"], key=lambda candidate: candidate["inliers"])
        assert best["recording"] == "room"
        assert {"decode", "detect", "encode", "features", "filter", "rank", "match", "pose", "total"} <= set(
            answer["timing_ms"]
        )
        picture = cv2.imread(str(tmp_path / "plots" / f"{image.stem}.png"))
        assert picture.shape[0] > 600
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000


def test_both_coarse_steps_agree(url: str, images: list[Path]) -> None:
    answers = [
        semdb_json("localize", images[7], "--json", "--coarse", coarse, url=url)[0] for coarse in ("sql", "index")
    ]
    for answer in answers:
        del answer["timing_ms"]
    assert answers[0] == answers[1]


def test_query_depth_is_used(room: Path, url: str, images: list[Path]) -> None:
    depth = room / "depth" / sorted(path.name for path in (room / "depth").iterdir())[4]
    plain, deep = (
        semdb_json("localize", images[4], *extra, "--json", url=url)[0]
        for extra in ([], ["--depth", depth, "--like", room])
    )
    assert deep["verdict"] == "localized"
    assert np.trace(np.array(deep["covariance"])[:3, :3]) < np.trace(np.array(plain["covariance"])[:3, :3])


def test_an_image_outside_of_any_recording_takes_the_maps_camera(url: str, images: list[Path], tmp_path: Path) -> None:
    """Without masks of its own it is localized without the class filter: both are said."""
    lone = tmp_path / "lone.png"
    shutil.copy(images[4], lone)
    done = semdb("localize", lone, url=url)
    assert done.returncode == 0, done.stderr
    assert "localized" in done.stdout
    assert "camera of the images: that of the map's keyframes" in done.stderr
    assert "nothing is filtered by class" in done.stderr


def test_an_image_without_texture_fails_as_an_answer(room: Path, url: str, tmp_path: Path) -> None:
    copy = tmp_path / "grey"
    shutil.copytree(room, copy)
    image = sorted((copy / "rgb").iterdir())[4]
    cv2.imwrite(str(image), np.full((240, 320, 3), 128, np.uint8))
    [answer] = semdb_json("localize", image, "--json", url=url)
    assert answer["verdict"] == "failed"
    assert answer["pose"] is None
    assert answer["covariance"] is None
    assert answer["confidence"] == 0.0
    text = semdb("localize", image, "--plot", tmp_path / "plots", url=url)
    assert text.returncode == 0
    assert "failed" in text.stdout
    assert (tmp_path / "plots" / f"{image.stem}.png").is_file()


def test_one_broken_image_does_not_stop_the_others(url: str, images: list[Path], tmp_path: Path) -> None:
    broken = tmp_path / "truncated.png"
    broken.write_bytes(images[4].read_bytes()[:5000])
    done = semdb("localize", broken, images[7], "--json", url=url)
    assert done.returncode == 1
    assert "truncated.png" in done.stderr
    assert [answer["verdict"] for answer in json.loads(done.stdout)] == ["localized"]


def test_a_place_that_is_there_twice_is_ambiguous(room: Path, images: list[Path], tmp_path: Path) -> None:
    """The same room again, five metres away in the same map: no image can tell the two apart."""
    twin = tmp_path / "twin"
    shutil.copytree(room, twin)
    lines = (twin / "groundtruth.txt").read_text().splitlines()
    moved = [line.split() for line in lines if not line.startswith("#")]
    shifted = [" ".join([time, str(float(x) + 5), *rest]) for time, x, *rest in moved]
    (twin / "groundtruth.txt").write_text("\n".join(shifted) + "\n")
    made = f"sqlite:///{tmp_path / 'twins.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    for recording in (room, twin):
        ingest_recordings([recording], settings, IngestOptions(stride=4, map_name="one"))
    answers = semdb_json("localize", *images[2::7], "--json", url=made)
    assert len(answers) == 4
    for answer in answers:
        assert answer["verdict"] == "ambiguous"
        assert "elsewhere" in answer["reason"]
        assert answer["confidence"] <= 0.5
        [other, *_] = answer["others"]
        assert abs(abs(other["position"][0] - answer["pose"]["position"][0]) - 5) < 0.1


def test_queries_are_logged(url: str, images: list[Path]) -> None:
    before = semdb_json("sql", "SELECT COUNT(*) AS n FROM queries", "--format", "json", url=url)[0]["n"]
    semdb_json("localize", images[10], "--json", url=url)
    rows = semdb_json("sql", "SELECT verdict, image FROM queries ORDER BY id DESC LIMIT 1", "--format", "json", url=url)
    after = semdb_json("sql", "SELECT COUNT(*) AS n FROM queries", "--format", "json", url=url)[0]["n"]
    assert after == before + 1
    assert rows == [{"verdict": "localized", "image": str(images[10])}]


def test_two_maps_of_one_place_make_it_ambiguous(room: Path, images: list[Path], tmp_path: Path) -> None:
    made = f"sqlite:///{tmp_path / 'two.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    for name in ("one", "two"):
        ingest_recordings([room], settings, IngestOptions(stride=6, map_name=name))
    [answer] = semdb_json("localize", images[4], "--json", url=made)
    assert answer["verdict"] == "ambiguous"
    assert "map" in answer["reason"]
    [named] = semdb_json("localize", images[4], "--map", "two", "--json", url=made)
    assert (named["verdict"], named["map"]) == ("localized", "two")


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["localize", "nowhere.png"], 1, ["nowhere.png"]),
        (["localize", "TEXT"], 1, ["text.png"]),
        (["localize", "IMAGE", "--map", "attic"], 1, ["attic", "room"]),
        (["localize", "IMAGE", "--depth", "SMALL", "--like", "ROOM"], 1, ["small.png", "320x240"]),
        (["localize", "IMAGE", "--like", "attic"], 2, ["attic", "neither a recording", "recordings: room"]),
        (["localize", "IMAGE", "--camera", "1,2,x,4"], 2, ["--camera"]),
        (["localize", "IMAGE", "--coarse", "magic"], 2, ["magic"]),
        (["localize", "IMAGE", "--features", "sift"], 1, ["sift", "surf"]),
        (["localize", "IMAGE", "--detector", "onnx:nowhere.onnx"], 1, ["nowhere.onnx"]),
        (["ingest", "nowhere"], 1, ["nowhere"]),
        (["ingest", "FOLDER"], 1, ["no recording that semdb knows"]),
        (["ingest", "ROOM", "--keyframes", "900", "--map", "x"], 2, ["900", "24"]),
        (["evaluate", "ROOM", "--method", "magic"], 2, ["magic", "sift-reference"]),
        (["evaluate", "ROOM", "--keyframes", "24"], 2, ["--keyframes"]),
        (["evaluate", "ROOM", "--keyframes", "x"], 2, ["--keyframes"]),
    ],
)
def test_bad_input_is_one_line_and_an_exit_code(
    arguments: list[str], code: int, words: list[str], room: Path, url: str, images: list[Path], tmp_path: Path
) -> None:
    (tmp_path / "text.png").write_text("this is no picture")
    cv2.imwrite(str(tmp_path / "small.png"), np.full((60, 80), 5000, np.uint16))
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "notes.txt").write_text("nothing")
    stand_for = {
        "TEXT": tmp_path / "text.png",
        "IMAGE": images[4],
        "SMALL": tmp_path / "small.png",
        "ROOM": room,
        "FOLDER": tmp_path / "empty",
    }
    done = semdb(*(stand_for.get(argument, argument) for argument in arguments), url=url, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
    errors = [line for line in done.stderr.splitlines() if line.startswith("semdb: ")]
    assert errors, done.stderr
    for word in words:
        assert word in done.stderr


def test_an_empty_map_and_no_database(room: Path, images: list[Path], tmp_path: Path) -> None:
    made = f"sqlite:///{tmp_path / 'none.sqlite3'}"
    done = semdb("localize", images[4], url=made)
    assert done.returncode == 1
    assert "semdb ingest" in done.stderr
    assert not (tmp_path / "none.sqlite3").exists()
    assert semdb("init", url=made).returncode == 0
    empty = semdb("localize", images[4], url=made)
    assert empty.returncode == 1
    assert "no keyframe" in empty.stderr


def test_evaluate_writes_what_the_contract_names(room: Path, url: str, tmp_path: Path) -> None:
    done = semdb(
        *("evaluate", room, "--keyframes", 8, "--max-queries", 3, "--method", "semdb", "--method", "cnn"),
        *("--method", "sift-reference", "--method", "oracle", "--method", "paper", "--method", "chen"),
        *("--json", tmp_path / "e.json", "--report", tmp_path / "report"),
        url=url,
    )
    assert done.returncode == 0, done.stderr
    results = json.loads((tmp_path / "e.json").read_text())
    assert [result["method"] for result in results] == ["semdb", "cnn", "sift-reference", "oracle", "paper", "chen"]
    for result in results:
        assert (result["frames"], result["keyframes"], result["queries"]) == (24, 8, 3)
        assert result["protocol"] == "paper"
        assert len(result["per_query"]) == 3
        assert result["success_rate"] == result["localized"] / 3
    semantic, blind = results[0], results[1]
    assert semantic["localized"] == blind["localized"] == 3
    assert semantic["false_localizations"] == 0
    assert semantic["median_translation_m"] < 0.02
    assert semantic["ranked_share"] < 1.0 == blind["ranked_share"]
    assert set(semantic["recall"]) == {"5cm_5deg", "0.25m_2deg", "0.3m", "2.5deg"}
    assert (tmp_path / "report" / "index.html").stat().st_size > 20_000
    rows = (tmp_path / "report" / "queries.csv").read_text().splitlines()
    assert len(rows) == 1 + 6 * 3
    # the user's own database was not touched
    assert semdb_json("sql", "SELECT COUNT(*) AS n FROM maps", "--format", "json", url=url) == [{"n": 1}]


def damage(path: Path) -> None:
    """Spoils an image in its middle: its header and its end stay right."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def test_evaluate_counts_and_names_frames_that_cannot_be_read(room: Path, tmp_path: Path) -> None:
    worn = tmp_path / "worn"
    shutil.copytree(room, worn)
    for image in sorted((worn / "rgb").iterdir())[1:13:2]:
        damage(image)
    done = semdb(
        *("evaluate", worn, "--keyframes", 20, "--method", "semdb", "--method", "sift-reference"),
        *("--json", tmp_path / "e.json"),
        url=f"sqlite:///{tmp_path / 'unused.sqlite3'}",
    )
    assert done.returncode == 0, done.stderr
    for result in json.loads((tmp_path / "e.json").read_text()):
        assert result["keyframes"] < 20  # six are broken, and four frames are no keyframes
        assert result["keyframes"] + result["queries"] == 18
    assert "6 of 24 frames could not be used" in done.stderr
    assert "wrong checksum" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--json", "missing/e.json"], "--json missing/e.json"),
        (["--json", "."], "cannot be written"),
        (["--coarse", "hash"], "known are sql and index"),
        (["--max-queries", "0"], "at least one query"),
    ],
)
def test_evaluate_says_at_once_what_would_be_wrong_in_the_end(
    room: Path, tmp_path: Path, arguments: list[str], words: str
) -> None:
    # the server is not asked: nothing answers at this address
    done = semdb("evaluate", room, *arguments, url="mysql+pymysql://ann:secret@127.0.0.1:9/semdb", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert words in done.stderr


def test_evaluate_on_a_server_that_does_not_answer(room: Path) -> None:
    done = semdb("evaluate", room, url="mysql+pymysql://ann:secret@127.0.0.1:9/semdb")
    assert done.returncode == 1
    assert "does not answer" in done.stderr
    assert "secret" not in done.stderr


def test_evaluate_on_a_server_gives_the_same_figures_and_leaves_nothing(
    room: Path, any_server_url: str, tmp_path: Path
) -> None:
    from sqlalchemy import create_engine, text

    files = []
    for number, url in enumerate((f"sqlite:///{tmp_path / 'x.sqlite3'}", any_server_url)):
        files.append(tmp_path / f"{number}.json")
        done = semdb("evaluate", room, "--keyframes", 6, "--max-queries", 5, "--json", files[-1], url=url)
        assert done.returncode == 0, done.stderr
    one, two = (json.loads(path.read_text()) for path in files)
    for result in (one, two):
        del result["timing_ms"]
        for query in result["per_query"]:
            del query["timing_ms"]
    assert one == two
    engine = create_engine(any_server_url)
    with engine.connect() as connection:
        schemas = connection.execute(text("SHOW DATABASES LIKE 'semdb_evaluate%'")).all()
    engine.dispose()
    assert schemas == []


def test_photos_without_masks_are_localized_and_it_is_said(
    room: Path, url: str, images: list[Path], tmp_path: Path
) -> None:
    """Copies of frames outside their recording, in a map whose objects are recorded masks."""
    photos = [Path(shutil.copy(image, tmp_path / f"photo-{image.name}")) for image in (images[4], images[13])]
    done = semdb("localize", *photos, "--json", url=url)
    assert done.returncode == 0, done.stderr
    for answer, image in zip(json.loads(done.stdout), (images[4], images[13]), strict=True):
        assert (answer["verdict"], answer["stage"], answer["ranked_share"]) == ("localized", "all", 1.0)
        assert answer["reason"].endswith("; the image has no masks of its own: nothing is filtered by class")
        pose = pose_from(rotation_from_quat_wxyz(answer["pose"]["quat_wxyz"]), answer["pose"]["position"])
        metres, degrees = pose_error(pose, true_pose(room, image))
        assert metres < 0.02
        assert degrees < 0.5
    assert done.stderr.count("an image without masks is localized without objects") == 1


def test_a_camera_without_masks_is_tracked(room: Path, url: str, images: list[Path], tmp_path: Path) -> None:
    said: list[str] = []
    with semdb_open(url, threads=1, say=said.append) as database:
        tracker = database.tracker("room")
        found = [tracker.update(image.read_bytes(), time_s=0.1 * k) for k, image in enumerate(images[4:6])]
    assert "nothing is filtered by class" in found[0].reason
    assert [one.world_from_camera is not None for one in found] == [True, True]
    assert sum("without masks" in line for line in said) == 1
