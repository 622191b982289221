"""What a recording says of itself against its images: what is wrong is found, what is right is left alone."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.database.findings import list_findings
from semdb.database.store import open_store
from semdb.geometry import invert_pose, pose_from, quat_wxyz_from_rotation, rotation_from_quat_wxyz, so3_exp
from semdb.recordings import Recording, open_recording, parse_camera
from semdb.recordings.check import Finding, Report, check_recording
from semdb.recordings.check.pairs import look, match
from semdb.recordings.check.readings import Reading, readings, reread
from semdb.recordings.options import AXES, ReadOptions, read_options
from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from semdb.types import FloatArray
from tests.rooms import semdb, semdb_json

Pose = Callable[[FloatArray], FloatArray]


def trajectory(folder: Path) -> tuple[list[str], list[FloatArray]]:
    rows = [line.split() for line in (folder / "groundtruth.txt").read_text().splitlines() if not line.startswith("#")]
    values = [[float(value) for value in row[1:]] for row in rows]
    return [row[0] for row in rows], [pose_from(rotation_from_quat_wxyz([v[6], *v[3:6]]), v[:3]) for v in values]


def with_poses(
    source: Path, target: Path, change: Pose, *, wxyz: bool = False, later_s: float = 0.0, unit: float = 1.0
) -> Path:
    """A copy of a recording with other numbers in its ground truth."""
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("masks"))
    times, poses = trajectory(source)
    lines = []
    for time, pose in zip(times, map(change, poses), strict=True):
        w, x, y, z = quat_wxyz_from_rotation(pose[:3, :3])
        quat = (w, x, y, z) if wxyz else (x, y, z, w)
        lines.append(f"{float(time) + later_s:.6f} " + " ".join(f"{v:.9f}" for v in (*(pose[:3, 3] / unit), *quat)))
    (target / "groundtruth.txt").write_text("\n".join(lines) + "\n")
    return target


def with_depth(source: Path, target: Path, change: Callable[[np.ndarray], np.ndarray]) -> Path:
    """A copy of a recording whose depth images are changed."""
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("masks"))
    for file in (target / "depth").glob("*.png"):
        assert cv2.imwrite(str(file), change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))
    return target


def the_finding(recording: Recording, kind: str) -> Finding:
    report = check_recording(recording)
    assert [finding.kind for finding in report.findings] == [kind], report
    return report.findings[0]


def assert_mended(folder: Path, *findings: Finding) -> None:
    """The options that were named make the check find nothing any more."""
    pairs = [finding.option.removeprefix("--").split() for finding in findings]
    said = dict(pair for pair in pairs if pair[0] != "camera")
    camera = next((parse_camera(value) for name, value in pairs if name == "camera"), None)
    options = read_options("&".join(f"{name.replace('-', '_')}={value}" for name, value in said.items()))
    mended = check_recording(open_recording(folder, camera, options))
    assert mended.findings == ()
    assert mended.error_px < 5


def test_a_right_recording_is_left_alone(room: Path) -> None:
    report = check_recording(open_recording(room))
    assert report.findings == ()
    assert report.pairs >= 6
    assert report.error_px < 1
    assert report.floor_px < 1


WRONG: dict[str, tuple[Pose, bool, str, str]] = {
    "inverted": (invert_pose, False, "poses_are", "--poses-are camera_from_world"),
    "opengl": (lambda pose: pose @ invert_pose(AXES["opengl"]), False, "axes", "--axes opengl"),
    "ros": (lambda pose: pose @ invert_pose(AXES["ros"]), False, "axes", "--axes ros"),
    "wxyz": (lambda pose: pose, True, "quaternion", "--quaternion wxyz"),
}


@pytest.mark.parametrize("name", sorted(WRONG))
def test_poses_read_wrongly_are_found_with_the_option_that_mends_them(room: Path, tmp_path: Path, name: str) -> None:
    change, wxyz, kind, option = WRONG[name]
    folder = with_poses(room, tmp_path / name, change, wxyz=wxyz)
    finding = the_finding(open_recording(folder), kind)
    assert finding.certain
    assert finding.option == option
    assert_mended(folder, finding)


def test_poses_that_are_of_something_else(room: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    folder = with_poses(
        room, tmp_path / "walk", lambda pose: pose @ pose_from(so3_exp(rng.normal(size=3)), rng.normal(size=3))
    )
    finding = the_finding(open_recording(folder), "poses")
    assert (finding.certain, finding.option) == (False, "")
    assert float(finding.value) > 25
    still = with_poses(room, tmp_path / "still", lambda pose: np.eye(4))
    assert not the_finding(open_recording(still), "poses").certain


@pytest.mark.parametrize(("factor", "value"), [(0.2, 1000), (2.0, 10000), (0.02, 100)])
def test_another_depth_scale(room: Path, tmp_path: Path, factor: float, value: int) -> None:
    folder = with_depth(
        room, tmp_path / "room", lambda depth: np.rint(np.minimum(depth * factor, 65534)).astype(np.uint16)
    )
    finding = the_finding(open_recording(folder), "depth_scale")
    assert (finding.certain, finding.value, finding.option) == (True, value, f"--depth-scale {value}")
    assert_mended(folder, finding)


def test_poses_in_millimetres(room: Path, tmp_path: Path) -> None:
    folder = with_poses(room, tmp_path / "room", lambda pose: pose, unit=0.001)
    finding = the_finding(open_recording(folder), "scale")
    assert (finding.certain, finding.value, finding.option) == (True, 0.001, "--scale 0.001")
    assert_mended(folder, finding)


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """At 30 Hz: poses and depth of 0.1 to 0.3 s before are others."""
    folder = tmp_path_factory.mktemp("video") / "room"
    write_synthetic_recording(folder, SyntheticOptions(frames=60, width=160, height=120, lap_frames=240))
    return folder


def with_clocks(source: Path, target: Path, poses_s: float = 0.0, depth_s: float = 0.0) -> Path:
    """A copy whose clocks of poses and depth are ahead of colour's."""
    shutil.copytree(source, target, ignore=shutil.ignore_patterns("masks"))
    for name, later in (("groundtruth.txt", poses_s), ("depth.txt", depth_s)):
        rows = [line.split(" ", 1) for line in (target / name).read_text().splitlines() if not line.startswith("#")]
        (target / name).write_text("".join(f"{float(time) + later:.6f} {rest}\n" for time, rest in rows))
    return target


@pytest.mark.parametrize("later", [0.3, -0.2])
def test_a_clock_of_poses_that_is_off(video: Path, tmp_path: Path, later: float) -> None:
    folder = with_clocks(video, tmp_path / "off", poses_s=later)
    finding = the_finding(open_recording(folder), "time_offset")
    assert finding.certain
    assert float(finding.value) == pytest.approx(-1000 * later, abs=10)
    assert_mended(folder, finding)


@pytest.mark.parametrize("later", [0.1, 0.3, -0.2])
def test_a_clock_of_depth_that_is_off(video: Path, tmp_path: Path, later: float) -> None:
    folder = with_clocks(video, tmp_path / "off", depth_s=later)
    finding = the_finding(open_recording(folder), "depth_time_offset")
    assert not finding.certain
    assert float(finding.value) == pytest.approx(-1000 * later, abs=10)
    assert_mended(folder, finding)


def test_times_of_colour_and_depth_that_are_interchanged(video: Path, tmp_path: Path) -> None:
    """Depth was taken 0.1 s before colour; each got the times of the other."""
    folder = with_clocks(video, tmp_path / "off", poses_s=-0.1, depth_s=-0.2)  # about the clock of colour
    findings = check_recording(open_recording(folder)).findings
    assert [(f.kind, f.certain) for f in findings] == [("time_offset", True), ("depth_time_offset", False)]
    assert [float(f.value) for f in findings] == pytest.approx([100, 200], abs=15)
    assert_mended(folder, *findings)


def test_poses_that_run_backwards(video: Path, tmp_path: Path) -> None:
    folder = with_clocks(video, tmp_path / "back")
    rows = [line.split(" ", 1) for line in (folder / "groundtruth.txt").read_text().splitlines()]
    turned = [f"{time} {rest}\n" for (time, _), (_, rest) in zip(rows, reversed(rows), strict=True)]
    (folder / "groundtruth.txt").write_text("".join(turned))
    finding = the_finding(open_recording(folder), "times")
    assert (finding.certain, finding.option) == (True, "--times reversed")
    assert_mended(folder, finding)


def test_a_turned_world_hides_nothing(room: Path, tmp_path: Path) -> None:
    folder = with_poses(room, tmp_path / "walk", invert_pose)
    wrong = check_recording(open_recording(folder, options=ReadOptions(up="0,-1,0.2")))
    assert [finding.option for finding in wrong.findings] == ["--poses-are camera_from_world"]
    right = check_recording(open_recording(room, options=ReadOptions(up="0,-1,0.2")))
    assert right.findings == ()


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_wrong_focal_length(room: Path, tmp_path: Path, factor: float) -> None:
    folder = shutil.copytree(room, tmp_path / "room", ignore=shutil.ignore_patterns("masks"))
    content = json.loads((folder / "camera.json").read_text())
    right = content["fx"]
    content |= {"fx": factor * right, "fy": factor * content["fy"]}
    (folder / "camera.json").write_text(json.dumps(content))
    finding = the_finding(open_recording(folder), "focal")
    assert finding.certain
    assert float(finding.value) == pytest.approx(1 / factor, rel=0.03)
    assert float(finding.option.removeprefix("--camera ").split(",")[0]) == pytest.approx(right, rel=0.03)
    assert_mended(folder, finding)


@pytest.mark.parametrize(("zoom", "shift"), [(1.15, (0, 0)), (0.9, (9, 0)), (1.0, (10, -8))])
def test_depth_of_another_camera(room: Path, tmp_path: Path, zoom: float, shift: tuple[int, int]) -> None:
    """As a camera beside it with another focal length sees it: pixels of an image of 320."""

    def seen(depth: np.ndarray) -> np.ndarray:
        x, y = (1 - zoom) * 159.5 + shift[0], (1 - zoom) * 119.5 + shift[1]
        return cv2.warpAffine(depth, np.array([[zoom, 0, x], [0, zoom, y]]), (320, 240), flags=cv2.INTER_NEAREST)

    folder = with_depth(room, tmp_path / "room", seen)
    recording = open_recording(folder)
    finding = the_finding(recording, "depth_registration")
    assert not finding.certain
    assert float(finding.value) == pytest.approx(1 / zoom, abs=0.06)
    fx, _, cx, cy = (float(v) for v in finding.option.removeprefix("--depth-camera ").split(","))
    camera = recording.camera
    assert fx == pytest.approx(zoom * camera.fx, rel=0.04)
    assert cx == pytest.approx(zoom * (camera.cx - 159.5) + 159.5 + shift[0], abs=4)
    assert cy == pytest.approx(zoom * (camera.cy - 119.5) + 119.5 + shift[1], abs=4)
    assert_mended(folder, finding)


def test_ingest_stops_for_what_is_certain_and_goes_on_when_mended(room: Path, tmp_path: Path) -> None:
    folder = with_poses(room, tmp_path / "walk", invert_pose)
    url = f"sqlite:///{tmp_path / 'm.sqlite3'}"
    on = {"SEMDB_CHECK_RECORDINGS": "true"}
    arguments = ("--keyframes", 4, "--encoder", "gist", "--detector", "recorded")
    shutil.copytree(room / "masks", folder / "masks")
    refused = semdb("ingest", folder, *arguments, url=url, **on)
    assert refused.returncode == 1
    assert "its images contradict how it is read: the poses are camera_from_world" in refused.stderr
    assert "say --poses-are camera_from_world (--no-check ingests it as it is)" in refused.stderr
    assert semdb_json("status", "--json", url=url) == []
    [summary] = semdb_json("ingest", folder, *arguments, "--poses-are", "camera_from_world", "--json", url=url, **on)
    assert (summary["stored"], summary["findings"]) == (4, [])
    [other] = semdb_json("ingest", folder, *arguments, "--no-check", "--name", "as-it-is", "--json", url=url, **on)
    assert other["stored"] == 4


def test_what_is_likely_is_said_and_kept(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from semdb.ingestion import contradictions
    from semdb.ingestion.run import IngestOptions, ingest_recordings
    from semdb.settings import Settings

    likely = Finding("depth_registration", False, 0.9, "", "depth is not registered to colour")
    report = Report((likely,), 9, 1.0, 0.5)
    monkeypatch.setattr(contradictions, "check_recording", lambda recording, progress: report)
    url = f"sqlite:///{tmp_path / 'm.sqlite3'}"
    settings = Settings(database_url=url, detector="recorded", encoder="gist", check_recordings=True)
    said: list[str] = []
    [summary] = ingest_recordings([room], settings, IngestOptions(keyframes=2), say=said.append)
    assert "room: likely: depth is not registered to colour" in said
    assert [finding.kind for finding in summary.findings] == ["depth_registration"]
    with open_store(url) as store:
        [kept] = list_findings(store.engine)[summary.recording_id]
    assert (kept.kind, kept.certain, kept.value, kept.message) == (
        "depth_registration",
        False,
        "0.9",
        "depth is not registered to colour",
    )


def test_the_command_exits_with_1_where_something_is_certain(room: Path, tmp_path: Path) -> None:
    folder = with_poses(room, tmp_path / "walk", invert_pose)
    wrong = semdb("recording", folder, "--check", "--json", url="sqlite:///x.sqlite3")
    assert wrong.returncode == 1
    [answer] = json.loads(wrong.stdout)
    assert [(f["kind"], f["certain"], f["value"], f["option"]) for f in answer["findings"]] == [
        ("poses_are", True, "camera_from_world", "--poses-are camera_from_world")
    ]
    right = semdb("recording", room, "--check", url="sqlite:///x.sqlite3")
    assert right.returncode == 0
    assert "nothing contradicts the images" in right.stdout


@pytest.mark.parametrize("name", ["7scenes_redkitchen", "tum_rgbd_dataset_freiburg1_rpy", "tum_freiburg3_cabinet"])
def test_real_recordings_are_left_alone(shared_dir: Path, name: str) -> None:
    report = check_recording(open_recording(shared_dir / "recordings" / name))
    assert report.findings == ()
    if name == "tum_freiburg3_cabinet":  # next to no texture: too few pairs, which is said
        assert report.pairs >= 3 or "nothing was checked" in report.notes[0]
        return
    assert report.pairs >= 10
    assert report.error_px < 9


@pytest.mark.parametrize(
    ("name", "reading", "kind"),
    [
        ("7scenes_redkitchen", {"depth_scale": 5000}, "depth_scale"),
        ("7scenes_redkitchen", {"axes": "ros"}, "axes"),
        ("tum_rgbd_dataset_freiburg1_rpy", {"depth_scale": 1000}, "depth_scale"),
        ("tum_rgbd_dataset_freiburg1_rpy", {"quaternion": "wxyz"}, "quaternion"),
    ],
)
def test_real_recordings_read_wrongly_are_found(
    shared_dir: Path, name: str, reading: dict[str, object], kind: str
) -> None:
    recording = open_recording(shared_dir / "recordings" / name, options=ReadOptions(**reading))  # type: ignore[arg-type]
    assert the_finding(recording, kind).certain


def test_readings_are_undone_by_each_other() -> None:
    rng = np.random.default_rng(0)
    poses = np.stack([pose_from(rotation_from_quat_wxyz(rng.normal(size=4)), rng.normal(size=3)) for _ in range(5)])
    for first in readings(Reading(), quaternions=True):
        for second in readings(first, quaternions=True):
            there = reread(poses, first, second)
            np.testing.assert_allclose(reread(there, second, first), poses, atol=1e-9)


def test_images_without_anything_to_match_are_no_pair() -> None:
    grey = np.full((48, 64, 3), 99, np.uint8)
    from tests.unit.recording_miniatures import SMALL

    assert match(look(0, grey, None, SMALL), look(1, grey, None, SMALL)) is None


def assert_not_suspected(folder: Path, seed: int) -> None:
    """A room of its own, with the noise of a sensor, every third time blurred."""
    options = SyntheticOptions(
        frames=24, width=320, height=240, seed=seed, room_seed=seed, noise=True, lap_frames=80, blur=(seed % 3) * 0.3
    )
    write_synthetic_recording(folder, options)
    assert check_recording(open_recording(folder)).findings == ()


@pytest.mark.parametrize("seed", [7, 31])
def test_rendered_rooms_with_noise_are_not_suspected(tmp_path: Path, seed: int) -> None:
    assert_not_suspected(tmp_path / "room", seed)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(50))
def test_no_rendered_room_with_noise_is_suspected(tmp_path: Path, seed: int) -> None:
    assert_not_suspected(tmp_path / "room", seed)


def test_where_nothing_could_be_checked_nothing_is_said_to_fit(tmp_path: Path) -> None:
    from semdb.cli.recording import check_lines

    nothing = Report((), 2, float("nan"), float("nan"), ("only 2 pairs of frames: nothing was checked",))
    assert not any("nothing contradicts" in line for line in check_lines(nothing))
    assert any("nothing contradicts" in line for line in check_lines(Report((), 9, 0.5, 0.4)))
