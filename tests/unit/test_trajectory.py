"""Trajectories of small rendered rooms, start to end: how exact, what is left out, lost, and never joined."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import semdb
from semdb.cli.main import app
from semdb.errors import FrameError, RecordingError, UsageError
from semdb.evaluation.trajectory_errors import trajectory_errors
from semdb.ingestion.estimation import told
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features.surf_features import SurfFeatures
from semdb.recordings import open_recording
from semdb.recordings.synthetic import SyntheticOptions
from semdb.recordings.synthetic.writer import SyntheticSequence
from semdb.trajectory.edges import EdgeState
from semdb.trajectory.odometry import FrameState
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.recording import find_recorded
from semdb.trajectory.result import Trajectory
from semdb.trajectory.run import find_trajectory
from semdb.types import Camera, Float32Array, FloatArray, Frame, ImageArray
from tests.rooms import SMALL

Picture = tuple[ImageArray, Float32Array | None]


@dataclass(frozen=True, eq=False)
class Frames:
    """Frames in memory. A picture of None cannot be read."""

    camera: Camera
    pictures: list[Picture | None]
    true: FloatArray

    def read(self, position: int) -> Picture:
        picture = self.pictures[position]
        if picture is None:
            raise FrameError(f"rgb/{position}.png: cut off")
        return picture

    def find(
        self, options: TrajectoryOptions | None = None, told: Callable[[str, int, int], None] | None = None
    ) -> Trajectory:
        count = len(self.pictures)
        return find_trajectory(
            self.read, [self.camera] * count, np.arange(count) / 30, SurfFeatures(max_keypoints=800), GistEncoder(),
            options or TrajectoryOptions(threads=1), told,
        )  # fmt: skip


def rendered(options: SyntheticOptions) -> Frames:
    sequence = SyntheticSequence(options)
    pictures: list[Picture | None] = []
    for index in range(options.frames):
        frame = sequence.render(index)
        pictures.append((frame.rgb, frame.known_depth))
    return Frames(sequence.camera, pictures, sequence.poses)


@pytest.fixture(scope="module")
def room() -> Frames:
    return rendered(SMALL)


@pytest.fixture(scope="module")
def other_room() -> Frames:
    return rendered(SyntheticOptions(frames=8, width=320, height=240, lap_frames=80, room_seed=9, seed=4))


def errors_of(found: Trajectory, true: FloatArray) -> tuple[float, float]:
    """RMSE of positions (m), and the greatest error of a motion over a third of a second (deg)."""
    used = found.used
    poses = np.stack([frame.world_from_camera for frame in used if frame.world_from_camera is not None])
    positions = [frame.position for frame in used]
    errors = trajectory_errors(poses, true[positions], np.array(positions) / 30, 1 / 3)
    return errors.rmse_m, float(errors.relative_rmse_deg or 0.0)


def splice(*parts: Sequence[Picture | None]) -> list[Picture | None]:
    return [picture for part in parts for picture in part]


def test_a_rendered_room_is_tracked_to_millimetres(room: Frames) -> None:
    found = room.find()
    assert [frame.state for frame in found.frames] == [FrameState.TRACKED] * 24
    metres, degrees = errors_of(found, room.true)
    assert metres < 0.004
    assert degrees < 0.2
    assert 3 <= len(found.keyframes) <= 20
    assert len(found.pieces) == 1
    assert found.pieces[0].frames == 24


def test_the_world_is_upright_from_the_first_keyframe_on(room: Frames) -> None:
    found, plain = room.find(), room.find(TrajectoryOptions(threads=1, upright=False))
    first = found.frames[0].world_from_camera
    assert first is not None
    assert found.up is not None
    np.testing.assert_allclose(first[:3, 3], 0.0, atol=1e-12)
    assert first[1, 2] == pytest.approx(0.0, abs=1e-9)  # it looks along x
    assert first[0, 2] > 0.9
    up = (room.true[0] @ np.linalg.inv(first))[:3, :3] @ [0.0, 0.0, 1.0]
    assert np.degrees(np.arccos(up[2])) < 3 * found.up.sigma_deg < 4
    np.testing.assert_array_equal(plain.frames[0].world_from_camera, np.eye(4))
    assert plain.up is None
    for one, two in zip(found.used, plain.used, strict=True):
        np.testing.assert_allclose(np.linalg.inv(first) @ one.world_from_camera, two.world_from_camera, atol=1e-9)
        np.testing.assert_allclose(np.linalg.eigvalsh(one.covariance), np.linalg.eigvalsh(two.covariance), atol=1e-12)


def test_covariances_grow_away_from_the_first_keyframe_and_hold_the_error(room: Frames) -> None:
    found = room.find()
    sigmas = [
        float(np.sqrt(np.trace(frame.covariance[:3, :3]))) for frame in found.used if frame.covariance is not None
    ]
    assert len(sigmas) == 24
    assert sigmas[0] < 1e-6
    assert 0.0003 < np.median(sigmas[12:]) < 0.03
    world = room.true[0] @ np.linalg.inv(np.asarray(found.frames[0].world_from_camera))
    off = [np.linalg.norm((world @ f.world_from_camera)[:3, 3] - room.true[f.position][:3, 3]) for f in found.used[1:]]
    assert np.median(np.array(off) / sigmas[1:]) < 3


def test_threads_and_repetition_change_nothing(room: Frames) -> None:
    one, two = room.find(TrajectoryOptions(threads=1)), room.find(TrajectoryOptions(threads=2))
    for a, b in zip(one.frames, two.frames, strict=True):
        np.testing.assert_array_equal(a.world_from_camera, b.world_from_camera)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    assert one.keyframes == two.keyframes


def test_progress_is_told(room: Frames) -> None:
    told: list[tuple[str, int, int]] = []
    room.find(told=lambda what, done, total: told.append((what, done, total)))
    assert ("tracking", 24, 24) in told
    assert ("placing frames", 24, 24) in told
    assert {"bundle adjustment"} <= {what for what, _, _ in told}


def test_dark_plain_and_broken_frames_are_left_out_and_said(room: Frames) -> None:
    black: Picture = (np.zeros((240, 320, 3), np.uint8), room.read(5)[1])
    plain: Picture = (np.full((240, 320, 3), 128, np.uint8), room.read(9)[1])
    pictures = list(room.pictures)
    pictures[5], pictures[9], pictures[12] = black, plain, None
    found = Frames(room.camera, pictures, room.true).find()
    states = [frame.state for frame in found.frames]
    assert [n for n, state in enumerate(states) if state is not FrameState.TRACKED] == [5, 9, 12]
    assert {states[n] for n in (5, 9, 12)} == {FrameState.LEFT_OUT}
    assert found.frames[5].reason.startswith("too dark")
    assert found.frames[9].reason.startswith("shows nothing")
    assert found.frames[12].reason == "rgb/12.png: cut off"
    metres, _ = errors_of(found, room.true)
    assert metres < 0.005


def test_frames_without_depth_are_tracked_but_become_no_keyframes(room: Frames) -> None:
    pictures = [picture if n % 2 == 0 else (room.read(n)[0], None) for n, picture in enumerate(room.pictures)]
    found = Frames(room.camera, pictures, room.true).find()
    assert all(frame.placed for frame in found.frames)
    assert all(position % 2 == 0 for position in found.keyframes)
    metres, _ = errors_of(found, room.true)
    assert metres < 0.006


def test_what_was_lost_is_found_again_among_keyframes(room: Frames, other_room: Frames) -> None:
    """Three frames of another room, too few for a piece of their own, then the first room goes on elsewhere."""
    pictures = splice(room.pictures[:12], other_room.pictures[:3], room.pictures[4:10])
    true = np.concatenate([room.true[:12], other_room.true[:3], room.true[4:10]])
    found = Frames(room.camera, pictures, true).find()
    assert [frame.state for frame in found.frames[12:15]] == [FrameState.LOST] * 3
    assert "too little of it" in found.frames[12].reason
    assert found.frames[15].state in (FrameState.RELOCALIZED, FrameState.TRACKED)
    assert len(found.pieces) == 1
    metres, _ = errors_of(found, true)
    assert metres < 0.005


def test_another_room_is_a_piece_of_its_own_and_named(room: Frames, other_room: Frames) -> None:
    pictures = splice(room.pictures[:12], other_room.pictures)
    found = Frames(room.camera, pictures, np.concatenate([room.true[:12], other_room.true])).find()
    assert len(found.pieces) == 2
    first, second = found.pieces
    assert (first.number, first.first_position) == (0, 0)
    assert first.frames >= 12
    assert second.first_position >= 12
    assert second.last_position == len(pictures) - 1
    assert all(edge.state is not EdgeState.ACCEPTED for edge in found.edges if _between(edge.first, edge.second, found))
    assert {frame.position for frame in found.used} == set(range(12))


def _between(first: int, second: int, found: Trajectory) -> bool:
    ends = [found.frames[found.keyframes[number]].piece for number in (first, second)]
    return ends[0] != ends[1]


def test_pieces_that_see_the_same_are_joined(room: Frames, other_room: Frames) -> None:
    """The room is left for long, and entered again where it was seen before."""
    pictures = splice(room.pictures[:16], other_room.pictures, room.pictures[2:18])
    true = np.concatenate([room.true[:16], other_room.true, room.true[2:18]])
    found = Frames(room.camera, pictures, true).find()
    again = found.frames[24:]
    assert {frame.piece for frame in (*found.frames[:16], *again) if frame.placed} == {0}
    metres, _ = errors_of(found, true)
    assert metres < 0.005


def test_loops_and_adjustment_can_be_left_out(room: Frames) -> None:
    found = room.find(TrajectoryOptions(threads=1, close_loops=False, adjust=False))
    assert all(edge.kind == "odometry" for edge in found.edges)
    metres, _ = errors_of(found, room.true)
    assert metres < 0.03


def test_nothing_but_black_frames_has_no_trajectory() -> None:
    black: Picture = (np.zeros((120, 160, 3), np.uint8), np.ones((120, 160), np.float32))
    camera = Camera(160, 120, 130, 130, 80, 60)
    found = Frames(camera, [black] * 4, np.tile(np.eye(4), (4, 1, 1))).find()
    assert not found.used
    assert found.pieces == ()
    assert found.count(FrameState.LEFT_OUT) == 4


# recordings and the command


def test_a_recording_is_found_whatever_poses_it_has(room_path: Path) -> None:
    recording = open_recording(room_path)
    found = find_recorded(recording, every=2, options=TrajectoryOptions(threads=1))
    assert found.timed
    assert [entry.index for entry in found.entries] == list(range(0, 24, 2))
    true = np.stack([entry.world_from_camera for entry in found.entries if entry.world_from_camera is not None])
    metres, _ = errors_of(found.trajectory, true)
    assert metres < 0.006
    with pytest.raises(UsageError, match="every must be at least 1"):
        find_recorded(recording, every=0)


@pytest.fixture(scope="module")
def room_path(room: Frames, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from tests.rooms import render

    return render(tmp_path_factory.mktemp("trajectory") / "room")


def test_the_command_writes_poses_json_and_a_picture(room_path: Path, tmp_path: Path) -> None:
    out, told, plots = tmp_path / "poses.txt", tmp_path / "found.json", tmp_path / "plots"
    result = CliRunner().invoke(
        app,
        ["trajectory", str(room_path), "--out", str(out), "--json", str(told), "--plot", str(plots), "--every", "2"],
    )
    assert result.exit_code == 0, result.output
    assert "frames        12, tracked 12" in result.stdout
    rows = [line.split() for line in out.read_text().splitlines() if not line.startswith("#")]
    assert len(rows) == 12
    stamps = [entry.timestamp_ns for entry in open_recording(room_path).entries[::2]]
    assert [round(float(row[0]) * 1e9) for row in rows] == [stamp for stamp in stamps if stamp is not None]
    summary = json.loads(told.read_text())
    assert summary["frames"] == summary["tracked"] == summary["used"] == 12
    assert summary["keyframes"] == sum(pose["keyframe"] for pose in summary["poses"])
    assert len(summary["poses"][3]["covariance"]) == 6
    assert {edge["state"] for edge in summary["edges"]} <= {"accepted", "contradicted", "failed"}
    assert [path.name for path in plots.iterdir()] == ["room-trajectory.png"]


def test_the_command_refuses_what_it_cannot_do(room_path: Path, tmp_path: Path) -> None:
    run = CliRunner().invoke
    no_folder = run(app, ["trajectory", str(room_path), "--out", str(tmp_path / "none" / "poses.txt")])
    assert no_folder.exit_code == 2
    assert "name a file in a folder that exists" in no_folder.stderr
    (tmp_path / "colour").mkdir()
    for name in ("rgb", "rgb.txt", "camera.json"):
        (tmp_path / "colour" / name).symlink_to(room_path / name)
    no_depth = run(app, ["trajectory", str(tmp_path / "colour")])
    assert no_depth.exit_code == 1
    assert "without depth no trajectory is found" in no_depth.stderr
    assert run(app, ["trajectory", str(room_path), "--every", "0"]).exit_code == 2


def test_frames_that_cannot_be_used_are_told(room_path: Path, tmp_path: Path) -> None:
    """One whose depth is cut off, and one that shows nothing, of four."""
    import cv2

    for folder in ("rgb", "depth"):
        (tmp_path / folder).mkdir()
        lines = (room_path / f"{folder}.txt").read_text().splitlines()
        rows = [line for line in lines if not line.startswith("#")][:4]
        (tmp_path / f"{folder}.txt").write_text("\n".join(rows) + "\n")
        for row in rows:
            (tmp_path / row.split()[1]).write_bytes((room_path / row.split()[1]).read_bytes())
    (tmp_path / "camera.json").write_bytes((room_path / "camera.json").read_bytes())
    depth, colour = sorted((tmp_path / "depth").iterdir())[1], sorted((tmp_path / "rgb").iterdir())[2]
    depth.write_bytes(depth.read_bytes()[:2000])
    cv2.imwrite(str(colour), np.full((240, 320, 3), 128, np.uint8))
    out = tmp_path / "found.json"
    result = CliRunner().invoke(app, ["trajectory", str(tmp_path), "--json", str(out)])
    assert result.exit_code == 0, result.output
    assert "1 of 4 frames cannot be used; the first, rgb/" in result.stderr
    assert "no groundtruth.txt: the frames have no pose" in result.stderr
    summary = json.loads(out.read_text())
    assert ["the file ends too early" in one["reason"] for one in summary["dropped"]] == [True]
    assert (summary["frames"], summary["tracked"]) == (3, 2)
    said = told(find_recorded(open_recording(tmp_path), options=TrajectoryOptions(threads=1)))
    assert "left out without a pose: 1 x shows nothing: the image is of one grey: frame 2" in said


def test_a_recording_of_black_frames_is_an_error(tmp_path: Path) -> None:
    import cv2

    for folder in ("rgb", "depth"):
        (tmp_path / folder).mkdir()
    for n in range(3):
        cv2.imwrite(str(tmp_path / f"rgb/{n}.png"), np.zeros((48, 64, 3), np.uint8))
        cv2.imwrite(str(tmp_path / f"depth/{n}.png"), np.full((48, 64), 5000, np.uint16))
    for folder in ("rgb", "depth"):
        lines = [f"{n}.0 {folder}/{n}.png" for n in range(3)]
        (tmp_path / f"{folder}.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "camera.json").write_text('{"fx": 60, "fy": 60, "cx": 32, "cy": 24, "width": 64, "height": 48}')
    with pytest.raises(RecordingError, match="no frame can be placed; the first: too dark"):
        find_recorded(open_recording(tmp_path), options=TrajectoryOptions(threads=1))


def test_recorded_poses_are_compared_with_estimated_ones(room_path: Path, tmp_path: Path) -> None:
    found = CliRunner().invoke(app, ["recording", str(room_path), "--check", "--trajectory", "--json"])
    assert found.exit_code == 0, found.output
    [told] = json.loads(found.stdout)
    compared = told["trajectory"]
    assert compared["frames"] == compared["estimated"] == 24
    assert compared["errors"]["rmse_m"] < 0.005
    assert compared["rotation_deg"] < 0.3
    assert compared["scale"] == pytest.approx(1.0, abs=0.02)
    for name in ("rgb", "rgb.txt", "depth", "depth.txt", "camera.json"):
        (tmp_path / name).symlink_to(room_path / name)
    without = CliRunner().invoke(app, ["recording", str(tmp_path), "--check", "--trajectory"])
    assert "no poses are recorded: semdb trajectory estimates them" in without.stdout
    assert CliRunner().invoke(app, ["recording", str(room_path), "--trajectory"]).exit_code == 2


def test_the_door_finds_a_trajectory_of_a_folder_and_of_frames(room_path: Path, tmp_path: Path) -> None:
    def frames() -> Iterator[Frame]:
        for n, seen in enumerate(list(open_recording(room_path).frames())[::3]):
            yield semdb.make_frame(n, seen.image, depth=seen.depth, camera=seen.camera, timestamp_ns=seen.timestamp_ns)

    with semdb.open(f"sqlite:///{tmp_path}/none.sqlite3") as db:
        folder, memory = db.trajectory(room_path, every=3), db.trajectory(frames())
        with pytest.raises(UsageError, match="every must be at least 1"):
            db.trajectory(room_path, every=0)
        with pytest.raises(RecordingError, match=r"^frames: no frame has depth"):
            db.trajectory(replace(frame, depth=None) for frame in frames())
    assert not (tmp_path / "none.sqlite3").exists()
    assert len(folder.trajectory.used) == len(memory.trajectory.used) == 8
    assert [entry.timestamp_ns for entry in folder.entries] == [entry.timestamp_ns for entry in memory.entries]
    for one, two in zip(folder.trajectory.used, memory.trajectory.used, strict=True):
        np.testing.assert_allclose(one.world_from_camera, two.world_from_camera, atol=0.005)
