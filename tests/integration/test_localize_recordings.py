"""`semdb localize` of recordings and folders, and `semdb show`, as a person runs them on a rendered room."""

from __future__ import annotations

import contextlib
import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import semdb as door
from semdb.cli.main import app
from semdb.geometry import pose_error, pose_from, rotation_from_quat_wxyz
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings import open_recording
from semdb.settings import Settings
from tests.terminal import Terminal
from tests.unit.onnx_files import write_constant_model


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


def semdb(*arguments: object, url: str, cwd: Path | None = None) -> Done:
    """``semdb ARGUMENTS`` in this process, which has its kernels compiled already."""
    with contextlib.chdir(cwd or Path.cwd()):
        result = CliRunner().invoke(app, [*map(str, arguments)], env={"SEMDB_DATABASE_URL": url, "SEMDB_THREADS": "1"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return Done(result.exit_code, result.stdout, result.stderr)


def semdb_json(*arguments: object, url: str) -> Any:
    done = semdb(*arguments, url=url)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def url(room: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """A database with the room, every third frame a keyframe."""
    made = f"sqlite:///{tmp_path_factory.mktemp('recordings') / 'semdb.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    ingest_recordings([room], settings, IngestOptions(stride=3, map_name="room"))
    return made


def poses_in(path: Path) -> dict[str, np.ndarray]:
    """Poses of a trajectory by the text of their time."""
    rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]
    return {
        time: pose_from(rotation_from_quat_wxyz([float(w), float(x), float(y), float(z)]), list(map(float, position)))
        for time, *position, x, y, z, w in rows
    }


@pytest.fixture
def without_poses(room: Path, tmp_path: Path) -> Path:
    copy = tmp_path / "room"
    shutil.copytree(room, copy)
    (copy / "groundtruth.txt").unlink()
    return copy


def test_a_recording_becomes_a_trajectory_with_its_own_times(
    room: Path, without_poses: Path, url: str, tmp_path: Path
) -> None:
    """Also one without poses, and evo reads it."""
    from evo.tools import file_interface

    entries = {f"{e.timestamp_ns / 1e9:.9f}": e for e in open_recording(room).entries[::5]}
    files = []
    for number, recording in enumerate((room, without_poses)):
        files.append(tmp_path / f"{number}.txt")
        done = semdb("localize", recording, "--every", 5, "--trajectory", files[-1], url=url)
        assert done.returncode == 0, done.stderr
        lines = done.stdout.splitlines()
        assert "in map room; sigma is one standard deviation" in lines[0]
        assert [line.split()[:2] for line in lines[2:-1]] == [
            [str(entry.index), "localized"] for entry in entries.values()
        ]
        assert lines[-1] == "localized 5 of 5"
        assert f"wrote 5 poses to {files[-1]}" in done.stderr
        found = poses_in(files[-1])
        assert list(found) == list(entries)
        for time, pose in found.items():
            metres, degrees = pose_error(pose, entries[time].world_from_camera)
            assert metres < 0.02
            assert degrees < 0.5
    assert files[0].read_text() == files[1].read_text()
    assert file_interface.read_tum_trajectory_file(str(files[0])).num_poses == 5
    assert sorted(path.name for path in tmp_path.iterdir()) == ["0.txt", "1.txt", "room"]


def test_a_folder_of_images(room: Path, url: str) -> None:
    done = semdb("localize", room / "rgb", "--every", 8, url=url)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    names = sorted(path.name for path in (room / "rgb").iterdir())[::8]
    assert [line.split()[0] for line in lines[2:-1]] == names
    assert lines[-1] == "localized 3 of 3"


def test_what_cannot_be_read_is_named_and_counted(room: Path, url: str, tmp_path: Path) -> None:
    worn = tmp_path / "worn"
    shutil.copytree(room, worn)
    broken = sorted((worn / "rgb").iterdir())[4]
    data = bytearray(broken.read_bytes())
    data[len(data) // 2] ^= 0xFF
    broken.write_bytes(data)
    (worn / "rgb" / "notes.txt").write_text("no image")
    for path in (worn, worn / "rgb"):
        done = semdb("localize", path, "--every", 4, url=url)
        assert done.returncode == 1
        assert done.stdout.splitlines()[-1] == "localized 5 of 6 (1 not read)"
        assert broken.name in done.stderr
    [*_, last] = semdb("localize", worn, "--every", 4, "--json", url=url).stdout.splitlines()
    assert last == "]"


def test_json_of_a_recording(room: Path, url: str) -> None:
    answers = semdb_json("localize", room, "--every", 10, "--json", url=url)
    entries = open_recording(room).entries[::10]
    assert [a["frame_index"] for a in answers] == [entry.index for entry in entries]
    assert [a["timestamp_ns"] for a in answers] == [entry.timestamp_ns for entry in entries]
    assert [Path(a["image"]) for a in answers] == [entry.image_path for entry in entries]
    plain = semdb_json("localize", entries[1].image_path, "--json", url=url)[0]
    for answer in (plain, answers[1]):
        del answer["timing_ms"]
    assert plain == answers[1]


def test_depth_of_a_recording_is_used_when_asked_for(room: Path, url: str) -> None:
    plain, deep = (
        semdb_json("localize", room, "--every", 20, *extra, "--json", url=url) for extra in ([], ["--query-depth"])
    )
    for without, with_depth in zip(plain, deep, strict=True):
        traces = [np.trace(np.array(a["covariance"])[:3, :3]) for a in (without, with_depth)]
        assert traces[1] < traces[0]


def test_the_same_through_the_door(room: Path, url: str) -> None:
    with door.open(url, threads=1) as db:
        answers = list(db.localize_recording(room, map="room", every=12))
        assert [answer.frame_index for answer in answers] == [0, 12]
        assert all(answer.localized for answer in answers)
        assert 0 < answers[0].sigma_m < 0.05
        assert db.tables()["maps"] == ("id", "name", "created_at")
        with pytest.raises(door.SemdbError, match="every=0"):
            db.localize_recording(room, every=0)


def test_sigma_says_what_it_is_of(room: Path, url: str) -> None:
    image = sorted((room / "rgb").iterdir())[4]
    with door.open(url, threads=1) as db:
        answer = db.localize(image)
    [line] = [line for line in semdb("localize", image, url=url).stdout.splitlines() if "sigma" in line]
    note = "(one standard deviation against the poses of the map's keyframes, where it is largest)"
    assert line == f"  sigma       position {1000 * answer.sigma_m:.1f} mm, rotation {answer.sigma_deg:.2f} deg {note}"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["ROOM", "--depth", "d.png"], "--query-depth"),
        (["ROOM", "ROOM", "--trajectory", "t.txt"], "--trajectory is of one recording"),
        (["IMAGE", "ROOM", "--trajectory", "t.txt"], "--trajectory is of one recording"),
        (["IMAGE", "--query-depth"], "--query-depth is for recordings"),
        (["IMAGE", "--axes", "ros"], "--axes is for recordings"),
        (["IMAGE", "--every", "0"], "--every"),
    ],
)
def test_options_that_make_no_sense(arguments: list[str], words: str, room: Path, url: str, tmp_path: Path) -> None:
    stand_for = {"ROOM": room, "IMAGE": sorted((room / "rgb").iterdir())[0]}
    done = semdb("localize", *(stand_for.get(word, word) for word in arguments), url=url, cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_trajectory_is_in_one_world(room: Path, tmp_path: Path) -> None:
    made = f"sqlite:///{tmp_path / 'two.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    for name in ("one", "two"):
        ingest_recordings([room], settings, IngestOptions(stride=12, map_name=name))
    target = tmp_path / "t.txt"
    target.write_text("kept")
    refused = semdb("localize", room, "--trajectory", target, url=made)
    assert refused.returncode == 2
    assert "there are one, two: say which with --map" in refused.stderr
    assert target.read_text() == "kept"
    done = semdb("localize", room, "--trajectory", target, "--map", "two", "--every", 12, url=made)
    assert done.returncode == 0, done.stderr
    assert len(poses_in(target)) == 2


def test_a_folder_that_is_nothing(url: str, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing")
    done = semdb("localize", tmp_path, url=url)
    assert done.returncode == 1
    assert "is no recording that semdb knows" in done.stderr


def test_colours_are_for_terminals_only(room: Path, url: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    image = str(sorted((room / "rgb").iterdir())[4])
    seen = {}
    for name, variables in (("colour", {}), ("plain", {"NO_COLOR": "1"}), ("dumb", {"TERM": "dumb"})):
        with Terminal("semdb", "localize", image, SEMDB_DATABASE_URL=url, **variables) as terminal:
            assert terminal.end() == 0
        seen[name] = terminal.raw
    assert "  verdict     \x1b[32mlocalized\x1b[0m (confidence" in seen["colour"]
    for name in ("plain", "dumb"):
        assert "  verdict     localized (confidence" in seen[name]
    assert "\x1b[32m" not in semdb("localize", image, url=url).stdout


# semdb show


def test_show_draws_keyframes_and_images(room: Path, url: str, tmp_path: Path) -> None:
    with door.open(url, threads=1) as db:
        keyframe = db.keyframe(db.keyframes("room")[2].id)
        assert len(keyframe.objects) > 1
        assert len(keyframe.keypoints) > 100
        assert keyframe.image.shape == (240, 320, 3)
        image = sorted((room / "rgb").iterdir())[7]
        seen = db.describe(image)
    done = semdb("show", keyframe.id, image, "--out", tmp_path / "pictures", url=url)
    assert done.returncode == 0, done.stderr
    for name, thing, pixels in (
        (f"keyframe-{keyframe.id}.png", keyframe, keyframe.image),
        (f"{image.stem}-objects.png", seen, seen.pixels),
    ):
        picture = cv2.imread(str(tmp_path / "pictures" / name))
        assert picture is not None
        assert picture.shape[0] > 720
        assert f"wrote {tmp_path / 'pictures' / name}" in done.stdout
        assert f"{len(thing.objects)} objects, {len(thing.keypoints)} keypoints, " in done.stdout
        for item in thing.objects:
            x1, y1, x2, y2 = (round(float(value)) for value in item.box)
            assert f"  {item.category} 1.00: x {x1} to {x2}, y {y1} to {y2}, " in done.stdout
        # the image lies at (24, 76), 720 pixels high; inside a mask it has the colour of the class, too
        scale = 720 / pixels.shape[0]
        largest = max(thing.objects, key=lambda item: int(item.mask.sum()))
        inside = cv2.erode(largest.mask.astype(np.uint8), np.ones((9, 9)))
        rows, columns = np.nonzero(inside)
        shown = picture[np.int32(76 + scale * (rows + 0.5)), np.int32(24 + scale * (columns + 0.5))][:, ::-1]
        outside = pixels[rows, columns].astype(float)
        assert np.abs(shown.mean(axis=0) - outside.mean(axis=0)).max() > 10


def test_show_for_programs(room: Path, url: str, tmp_path: Path) -> None:
    image = sorted((room / "rgb").iterdir())[7]
    keyframe, seen = semdb_json("show", 1, image, "--out", tmp_path, "--json", url=url)
    assert (keyframe["keyframe"], keyframe["map"], keyframe["recording"]) == (1, "room", "room")
    assert Path(keyframe["picture"]).is_file()
    assert sum(item["keypoints"] for item in keyframe["objects"]) <= keyframe["keypoints"]
    assert all(len(item["position"]) == 3 for item in keyframe["objects"])
    assert seen["image"] == str(image)
    assert all(item["position"] is None and len(item["box"]) == 4 for item in seen["objects"])


def test_show_without_a_map_takes_the_models_of_the_settings(room: Path, tmp_path: Path) -> None:
    """An image from anywhere: no camera, no map, not even a database."""
    masks = np.zeros((1, 1, 240, 320), np.float32)
    masks[:, :, 40:200, 60:260] = 1
    write_constant_model(
        tmp_path / "net.onnx",
        {
            "boxes": np.array([[60, 40, 259, 199]], np.float32),
            "labels": np.array([62], np.int64),
            "scores": np.array([0.9], np.float32),
            "masks": masks,
        },
    )
    shutil.copy(sorted((room / "rgb").iterdir())[3], tmp_path / "42")
    url = f"sqlite:///{tmp_path / 'none.sqlite3'}"
    done = semdb("show", "42", "--detector", "onnx:net.onnx", "--out", "a.jpg", url=url, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "  chair 0.90: x 60 to 259, y 40 to 199, " in done.stdout
    assert cv2.imread(str(tmp_path / "a.jpg")) is not None
    assert not (tmp_path / "none.sqlite3").exists()
    bare = semdb("show", "42", url=url, cwd=tmp_path)
    assert bare.returncode == 2
    assert "SEMDB_DETECTOR" in bare.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["99999"], 1, "there is no keyframe 99999"),
        (["9" * 30], 1, "there is no keyframe 999"),
        (["nowhere.png"], 1, "nowhere.png"),
        (["1", "2", "--out", "a.png"], 2, "2 pictures"),
        (["1", "--out", "a.gif"], 2, "written as .png or .jpg"),
        (["IMAGE", "--map", "attic"], 1, "no map 'attic'"),
    ],
)
def test_show_says_what_is_wrong(
    arguments: list[str], code: int, words: str, room: Path, url: str, tmp_path: Path
) -> None:
    image = sorted((room / "rgb").iterdir())[3]
    given = [str(image) if word == "IMAGE" else word for word in arguments]
    done = semdb("show", *given, url=url, cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
