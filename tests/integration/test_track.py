"""`semdb track` and trackers in a rendered room: where the camera is, that states are true, what comes of losses."""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import semdb as door
from semdb.api import Database
from semdb.cli.main import app
from semdb.door.tracked import Tracked
from semdb.errors import UsageError
from semdb.geometry import invert_pose, pose_error, pose_from, so3_exp
from semdb.geometry.tum import tum_line
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings import open_recording
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings
from semdb.types import Frame
from tests.rooms import render

STRIDE = 6


@dataclass
class Done:
    returncode: int
    stdout: str
    stderr: str


def semdb(*arguments: object, url: str, cwd: Path | None = None) -> Done:
    with contextlib.chdir(cwd or Path.cwd()):
        result = CliRunner().invoke(app, [*map(str, arguments)], env={"SEMDB_DATABASE_URL": url, "SEMDB_THREADS": "1"})
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return Done(result.exit_code, result.stdout, result.stderr)


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return render(
        tmp_path_factory.mktemp("walked") / "walk",
        SyntheticOptions(frames=48, width=320, height=240, lap_frames=160, noise=True),
    )


@pytest.fixture(
    scope="module", params=[{"room_seed": 5}, {"alike": True, "seed": 60}], ids=["another room", "one that looks alike"]
)
def elsewhere(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[Frame]:
    options = SyntheticOptions(frames=6, width=320, height=240, lap_frames=160, **request.param)
    return list(open_recording(render(tmp_path_factory.mktemp("other") / "other", options)).frames())


@pytest.fixture(scope="module")
def url(walked: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    made = f"sqlite:///{tmp_path_factory.mktemp('tracked') / 'semdb.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    ingest_recordings([walked], settings, IngestOptions(stride=STRIDE, map_name="room"))
    return made


@pytest.fixture
def database(url: str) -> Iterator[Database]:
    with door.open(url, threads=1) as opened:
        yield opened


@pytest.fixture(scope="module")
def frames(walked: Path) -> list[Frame]:
    return [frame for number, frame in enumerate(open_recording(walked).frames()) if number % STRIDE]


def error(answer: Tracked, frame: Frame) -> tuple[float, float]:
    assert answer.world_from_camera is not None
    assert frame.world_from_camera is not None
    return pose_error(answer.world_from_camera, frame.world_from_camera)


def test_every_frame_is_tracked_to_millimetres_and_its_covariance_is_true(
    database: Database, frames: list[Frame]
) -> None:
    tracker = database.tracker()
    answers = [tracker.update(frame) for frame in frames]
    assert [str(answer.state) for answer in answers] == ["tracking"] * len(frames)
    assert [str(answer.source) for answer in answers] == ["relocalised"] + ["tracked"] * (len(frames) - 1)
    off = np.array([error(a, f) for a, f in zip(answers, frames, strict=True)])
    assert np.median(off[:, 0]) < 0.003
    assert np.median(off[:, 1]) < 0.08
    assert off[:, 0].max() < 0.02
    within = [o < 3.5 * a.sigma_m for a, o in zip(answers, off[:, 0], strict=True)]
    assert np.mean(within) >= 0.9
    assert all(a.sigma_m < 0.02 for a in answers)


def test_frames_of_another_place_are_never_tracked(
    database: Database, frames: list[Frame], elsewhere: list[Frame]
) -> None:
    """Kidnapped: another room comes in between, and the camera goes on somewhere else in the map."""
    shown = [*frames[:8], *elsewhere, *frames[26:32]]
    tracker = database.tracker("room", camera=frames[0].camera)
    answers = [tracker.update(replace(f, timestamp_ns=n * 100_000_000)) for n, f in enumerate(shown)]
    states = [str(answer.state) for answer in answers]
    assert "tracking" not in states[8:14]
    assert "tracking" in states[14:16]  # two frames later at the latest
    for answer, frame in zip(answers[14:], shown[14:], strict=True):
        if answer.tracking:
            assert error(answer, frame)[0] < 0.03


def test_in_the_dark_it_coasts_and_says_how_unsure_it_is(database: Database, frames: list[Frame]) -> None:
    tracker = database.tracker("room")
    answers = []
    for number, frame in enumerate(frames):
        dark = 15 <= number < 21
        answers.append(tracker.update(replace(frame, image=np.zeros_like(frame.image)) if dark else frame))
    assert Counter(str(answer.state) for answer in answers[15:21]) == {"coasting": 6}
    assert all(str(answer.state) == "tracking" for answer in answers[21:])
    sigmas = [answer.sigma_m for answer in answers[15:21]]
    assert sigmas == sorted(sigmas)
    for answer, frame in zip(answers[15:21], frames[15:21], strict=True):
        assert error(answer, frame)[0] < 3 * answer.sigma_m
        assert "no keyframe" in answer.reason


def test_frames_of_a_fifth_of_the_light_are_tracked(database: Database, frames: list[Frame]) -> None:
    tracker, noise = database.tracker("room"), np.random.default_rng(0)
    for number, frame in enumerate(frames[:8]):
        dim = 51 * (frame.image / 255.0) ** 1.5 + noise.normal(0, 1.5, frame.image.shape)
        image = np.clip(dim, 0, 255).astype(np.uint8) if number >= 3 else frame.image
        answer = tracker.update(replace(frame, image=image))
        assert (str(answer.state), number, error(answer, frame)[0] < 0.03) == ("tracking", number, True)


def test_odometry_carries_through_the_dark_and_is_corrected(database: Database, frames: list[Frame]) -> None:
    """`map_from_odom` is what robots want: the correction of their own drifting frame."""
    odom_from_map = pose_from(so3_exp([0.1, -0.2, 1.0]), [3.0, -1.0, 0.5])
    tracker = database.tracker("room")
    for number, frame in enumerate(frames[:16]):
        assert frame.world_from_camera is not None
        seen = replace(frame, image=np.zeros_like(frame.image)) if number >= 10 else frame
        answer = tracker.update(seen, odometry=odom_from_map @ frame.world_from_camera)
    assert (str(answer.state), str(answer.source)) == ("coasting", "odometry")
    assert error(answer, frames[15])[0] < 0.005
    assert answer.map_from_odom is not None
    metres, degrees = pose_error(answer.map_from_odom, invert_pose(odom_from_map))
    assert metres < 0.02
    assert degrees < 0.3


def test_times_go_forwards_and_odometry_is_rigid(database: Database, frames: list[Frame]) -> None:
    tracker = database.tracker("room")
    tracker.update(frames[0])
    with pytest.raises(UsageError, match="in the order of their times"):
        tracker.update(frames[0])
    with pytest.raises(UsageError, match="rigid pose"):
        tracker.update(frames[1], odometry=2 * np.eye(4))


def test_the_command(url: str, walked: Path, tmp_path: Path) -> None:
    out = tmp_path / "poses.txt"
    done = semdb("track", walked, "--every", 3, "--out", out, url=url)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2 + 16 + 1
    assert lines[-1].startswith("tracked 16 of 16 frames, half of them within ")
    poses = [line for line in out.read_text().splitlines() if not line.startswith("#")]
    stamps = [entry.timestamp_ns for entry in open_recording(walked).entries[::3]]
    assert [round(float(line.split()[0]) * 1e3) for line in poses] == [round((s or 0) / 1e6) for s in stamps]


def test_lines_of_json_smoothed_with_odometry(url: str, walked: Path, tmp_path: Path) -> None:
    recording, file = open_recording(walked), tmp_path / "odometry.txt"
    known = [(e.timestamp_ns, e.world_from_camera) for e in recording.entries]
    file.write_text("\n".join(tum_line(t, pose) for t, pose in known if t is not None and pose is not None))
    done = semdb("track", walked, "--every", 4, "--smooth", "--odometry", file, "--json-lines", url=url)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) == 12
    assert all(f["smoothed"] and f["state"] == "tracking" for f in found)
    for answer, entry in zip(found, recording.entries[::4], strict=True):
        assert entry.world_from_camera is not None
        assert np.linalg.norm(np.array(answer["pose"]["position"]) - entry.world_from_camera[:3, 3]) < 0.02
        np.testing.assert_allclose(answer["map_from_odom"]["position"], 0, atol=0.03)  # it is the truth itself


def test_a_video_and_a_folder_of_images(walked: Path, tmp_path: Path, networks: dict[str, str]) -> None:
    url = f"sqlite:///{tmp_path / 'semdb.sqlite3'}"
    settings = Settings(database_url=url, features="surf", threads=1, **networks)
    ingest_recordings([walked], settings, IngestOptions(stride=STRIDE, map_name="room"))
    recording = open_recording(walked)
    camera = recording.camera_of(recording.entries[0])
    folder, video = tmp_path / "images", tmp_path / "walk.avi"
    folder.mkdir()
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 15, (320, 240))
    for number, entry in enumerate(recording.entries[1:5]):
        image = cv2.cvtColor(recording.read_image(entry), cv2.COLOR_RGB2BGR)
        writer.write(image)
        cv2.imwrite(str(folder / f"{number:03}.png"), image)
    writer.release()
    numbers = f"{camera.fx},{camera.fy},{camera.cx},{camera.cy}"
    models = ["--detector", networks["detector"], "--encoder", networks["encoder"]]
    for source, rate, hertz in ((folder, ["--rate", 10], 10), (video, [], 15)):
        done = semdb("track", source, "--camera", numbers, *rate, "--json-lines", *models, url=url)
        assert done.returncode == 0, done.stderr
        found = [json.loads(line) for line in done.stdout.splitlines()]
        assert [f["time_s"] for f in found] == pytest.approx([n / hertz for n in range(4)])
        assert [f["state"] for f in found] == ["tracking"] * 4
        for answer, entry in zip(found, recording.entries[1:5], strict=True):
            assert entry.world_from_camera is not None
            assert np.linalg.norm(np.array(answer["pose"]["position"]) - entry.world_from_camera[:3, 3]) < 0.02


def test_what_is_no_source_is_said(url: str, walked: Path, tmp_path: Path) -> None:
    for arguments, said in (
        ([tmp_path / "nothing.mp4"], "no frame of the video can be decoded"),
        ([tmp_path], "the folder is empty"),
        ([walked, "--rate", 3], "--rate is for folders"),
        ([walked, "--map", "other"], "other"),
    ):
        done = semdb("track", *arguments, url=url)
        assert done.returncode in (1, 2)
        assert said in done.stderr
