"""What a user says about a recording beside its files: which poses, axes, times and scales they are."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.errors import RecordingError, UsageError
from semdb.geometry import invert_pose, pose_error, pose_from, rotation_from_quat_wxyz, so3_exp
from semdb.recordings import ReadOptions, decode_depth, open_recording
from semdb.recordings.options import AXES, read_options, write_options
from semdb.types import Camera
from tests.unit.recording_miniatures import (
    SMALL,
    depth_units,
    pose,
    pose_text,
    render,
    write_icl,
    write_image,
    write_seven_scenes,
    write_tum,
)

TIMES = [f"{100 + i * 0.1:.6f}" for i in range(6)]


def write_poses(folder: Path, texts: list[str], shift_s: float = 0.0) -> None:
    times = [f"{float(time) + shift_s:.6f}" for time in TIMES]
    (folder / "groundtruth.txt").write_text(
        "\n".join(f"{time} {text}" for time, text in zip(times, texts, strict=True))
    )


def poses_of(folder: Path, options: ReadOptions) -> list[np.ndarray]:
    found = [entry.world_from_camera for entry in open_recording(folder, options=options).entries]
    return [pose for pose in found if pose is not None]


def assert_right(found: list[np.ndarray], n: int = 6) -> None:
    assert len(found) == n
    for i, one in enumerate(found):
        assert max(pose_error(one, pose(i))) < 1e-6


def test_inverted_poses(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk")
    write_poses(folder, [pose_text(invert_pose(pose(i))) for i in range(6)])
    assert_right(poses_of(folder, ReadOptions(poses_are="camera_from_world")))


@pytest.mark.parametrize("axes", sorted(AXES))
def test_axes_are_of_the_camera_whose_pose_is_given(tmp_path: Path, axes: str) -> None:
    # the forward axis of an OpenCV camera in each of the axes, by its definition
    forward = {"opencv": [0, 0, 1], "opengl": [0, 0, -1], "arkit": [0, 0, -1], "ros": [1, 0, 0]}[axes]
    down = {"opencv": [0, 1, 0], "opengl": [0, -1, 0], "arkit": [0, -1, 0], "ros": [0, 0, -1]}[axes]
    np.testing.assert_array_equal(AXES[axes][:3, 2], forward)
    np.testing.assert_array_equal(AXES[axes][:3, 1], down)
    assert np.linalg.det(AXES[axes]) == pytest.approx(1)
    folder = write_tum(tmp_path / "walk")
    write_poses(folder, [pose_text(pose(i) @ invert_pose(AXES[axes])) for i in range(6)])
    assert_right(poses_of(folder, ReadOptions(axes=axes)))


def test_quaternions_in_the_other_order_and_another_clock(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk")
    turned = []
    for i in range(6):
        x, y, z, qx, qy, qz, qw = pose_text(pose(i)).split()
        turned.append(" ".join((x, y, z, qw, qx, qy, qz)))
    write_poses(folder, turned, shift_s=0.25)
    assert_right(poses_of(folder, ReadOptions(quaternion="wxyz", time_offset_ms=-250)))


def test_poses_that_run_backwards(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk")
    write_poses(folder, [pose_text(pose(5 - i)) for i in range(6)])
    assert_right(poses_of(folder, ReadOptions(times="reversed")))


@pytest.mark.parametrize("up", ["0,0,1", "0,0,-2", "0,-1,0", "0.3,-0.5,0.1"])
@pytest.mark.parametrize("write", [write_tum, write_icl, write_seven_scenes])
def test_up_becomes_z(tmp_path: Path, up: str, write: Callable[[Path], Path]) -> None:
    folder = write(tmp_path / "seq-01")
    camera = None if write is write_seven_scenes else SMALL
    plain = open_recording(folder, camera)
    turned = open_recording(folder, camera, ReadOptions(up=up))
    direction = np.array([float(value) for value in up.split(",")])
    assert turned.world_turn is not None
    np.testing.assert_allclose(turned.world_turn[:3, :3] @ direction / np.linalg.norm(direction), [0, 0, 1], atol=1e-12)
    assert np.linalg.det(turned.world_turn[:3, :3]) == pytest.approx(1)
    for one, other in zip(plain.entries, turned.entries, strict=True):
        assert one.world_from_camera is not None
        np.testing.assert_allclose(turned.world_turn @ one.world_from_camera, other.world_from_camera, atol=1e-12)


def test_up_is_where_the_cameras_have_it(tmp_path: Path) -> None:
    """Upright cameras that look around: their y axis points down."""
    folder = write_tum(tmp_path / "walk")
    write_poses(folder, [pose_text(pose_from(so3_exp([0, 0.4 * i, 0]), [0.1 * i, 0, 0])) for i in range(6)])
    found = poses_of(folder, ReadOptions(up="cameras"))
    for one in found:
        np.testing.assert_allclose(one[:3, 1], [0, 0, -1], atol=1e-9)


def test_depth_of_another_scale_and_clock(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk")
    listed = (folder / "depth.txt").read_text().split("\n")[1:-1]
    shifted = [f"{float(line.split()[0]) + 0.3:.6f} {line.split()[1]}" for line in listed]
    (folder / "depth.txt").write_text("\n".join(shifted))
    plain = open_recording(folder)
    assert len(plain.entries) == 3  # 0.3 s later there is depth, but of another frame
    recording = open_recording(folder, options=ReadOptions(depth_scale=2500, depth_offset_ms=-300))
    assert len(recording.entries) == 6
    assert recording.depth_scale == 2500
    right, double = open_recording(write_tum(tmp_path / "right")), recording.read_depth(recording.entries[2])
    np.testing.assert_allclose(double, 2 * right.read_depth(right.entries[2]), rtol=1e-6)


def test_options_reach_the_poses_before_the_format_turns_them(tmp_path: Path) -> None:
    options = ReadOptions(poses_are="camera_from_world")
    for write in (write_icl, write_seven_scenes):
        right = write(tmp_path / "right" / write.__name__)
        wrong = write(tmp_path / "wrong" / write.__name__)
        for file in wrong.glob("*.pose.txt"):
            np.savetxt(file, invert_pose(np.loadtxt(file)))
        for file in wrong.glob("*.freiburg"):
            lines = []
            for line in file.read_text().splitlines():
                number, *values = line.split()
                x, y, z, qx, qy, qz, qw = map(float, values)
                one = pose_from(rotation_from_quat_wxyz([qw, qx, qy, qz]), [x, y, z])
                lines.append(f"{number} {pose_text(invert_pose(one))}")
            file.write_text("\n".join(lines))
        camera = None if write is write_seven_scenes else SMALL
        expected = [entry.world_from_camera for entry in open_recording(right, camera).entries]
        found = [entry.world_from_camera for entry in open_recording(wrong, camera, options).entries]
        assert len(found) == len(expected) >= 2
        for one, other in zip(found, expected, strict=True):
            assert max(pose_error(one, other)) < 1e-6


def test_depth_of_a_camera_beside_colour(tmp_path: Path) -> None:
    """Another focal length, 3 cm to the right: registered, colour's pixels have colour's depth."""
    folder = write_tum(tmp_path / "walk")
    own, place = Camera(64, 48, 55.0, 56.0, 30.0, 24.0), pose_from(np.eye(3), [0.03, -0.01, 0.005])
    for i in range(6):
        _, z = render(own, pose(i) @ place)
        write_image(folder / "depth" / f"{100 + i * 0.1 + 0.004:.6f}.png", depth_units(z, 5000))
    said = "55,56,30,24,0.03,-0.01,0.005"
    recording = open_recording(folder, options=ReadOptions(depth_camera=said))
    assert f"depth is of the camera {said} and registered to colour" in recording.notes
    for number, frame in enumerate(recording.frames()):
        image, z = render(SMALL, pose(number))
        np.testing.assert_array_equal(frame.image, image)
        assert frame.depth is not None
        assert frame.depth_bytes is not None
        assert np.isfinite(frame.depth).mean() > 0.7
        assert np.nanpercentile(np.abs(frame.depth - z), 95) < 0.01
        stored = decode_depth(frame.depth_bytes, "d", frame.depth_scale or 0, (64, 48))
        np.testing.assert_array_equal(stored, frame.depth)
        assert frame.depth_registration == ""
    with pytest.raises(UsageError, match="--depth-camera: fx and fy must be positive"):
        open_recording(folder, options=ReadOptions(depth_camera="0,56,30,24"))
    with pytest.raises(UsageError, match="--depth-camera: "):
        open_recording(folder, options=ReadOptions(depth_camera="5,56,30,24"))


def test_an_option_that_means_nothing_to_the_format_is_refused(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk")
    with pytest.raises(UsageError, match=r"walk: --color-topic means nothing to a recording of format tum; it takes"):
        open_recording(folder, options=ReadOptions(color_topic="/camera/rgb"))
    with pytest.raises(UsageError, match="--time-offset-ms"):
        open_recording(write_seven_scenes(tmp_path / "seq-01"), options=ReadOptions(time_offset_ms=3))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"depth_scale": 0.0}, "--depth-scale must be a positive number"),
        ({"scale": float("nan")}, "--scale must be a positive number"),
        ({"poses_are": "inverted"}, "--poses-are inverted: known are world_from_camera, camera_from_world"),
        ({"axes": "unity"}, "--axes unity: known are opencv, opengl, arkit, ros"),
        ({"quaternion": "zyxw"}, "--quaternion zyxw"),
        ({"times": "sideways"}, "--times sideways: known are reversed"),
        ({"up": "down"}, "--up takes x,y,z or cameras, but is 'down'"),
        ({"up": "0,0,0"}, "--up 0,0,0: no direction is up in it"),
        ({"depth_camera": "50,50,31.5"}, "--depth-camera takes fx,fy,cx,cy or fx,fy,cx,cy,x,y,z, but is '50,50,31.5'"),
        ({"time_offset_ms": float("inf")}, "--time-offset-ms must be a number of milliseconds"),
    ],
)
def test_options_that_make_no_sense(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        ReadOptions(**wrong)  # type: ignore[arg-type]


@given(
    st.builds(
        ReadOptions,
        depth_scale=st.none() | st.floats(1e-3, 1e6),
        axes=st.none() | st.sampled_from(sorted(AXES)),
        poses_are=st.sampled_from(["world_from_camera", "camera_from_world"]),
        time_offset_ms=st.floats(-1e9, 1e9),
        color_topic=st.none() | st.text(min_size=1),
    )
)
def test_options_are_written_and_read(options: ReadOptions) -> None:
    assert read_options(write_options(options)) == options


@pytest.mark.parametrize(("text", "message"), [("zoom=3", "'zoom' is no option"), ("scale=big", "'big' is no number")])
def test_written_options_that_are_none(text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        read_options(text)


def test_icl_nuim_with_matrices_is_the_same(tmp_path: Path) -> None:
    right, other = write_icl(tmp_path / "right"), write_icl(tmp_path / "other")
    expected = open_recording(right, SMALL).entries
    [file] = other.glob("*.gt.freiburg")
    blocks = []
    for line in file.read_text().splitlines():
        x, y, z, qx, qy, qz, qw = map(float, line.split()[1:])
        one = pose_from(rotation_from_quat_wxyz([qw, qx, qy, qz]), [x, y, z])
        blocks.append("\n".join(" ".join(f"{value:.12g}" for value in row) for row in one[:3]) + "\n\n")
    file.rename(other / "kept.txt")
    (other / "livingRoom1.gt.sim").write_text("".join(blocks))
    found = open_recording(other, SMALL).entries
    assert [entry.index for entry in found] == [entry.index for entry in expected]
    for one_entry, two in zip(found, expected, strict=True):
        assert one_entry.world_from_camera is not None
        assert two.world_from_camera is not None
        assert max(pose_error(one_entry.world_from_camera, two.world_from_camera)) < 1e-6
    (other / "livingRoom1.gt.sim").write_text("1 2 3 4\n")
    with pytest.raises(RecordingError, match=r"gt.sim: has 1 lines; three lines of a 3x4 matrix are needed"):
        open_recording(other, SMALL)


@pytest.mark.parametrize("timed", [True, False])
@pytest.mark.parametrize("numbers", [12, 16])
def test_tum_with_matrices(tmp_path: Path, timed: bool, numbers: int) -> None:
    folder = write_tum(tmp_path / "walk")
    rows = [" ".join(f"{value:.12g}" for value in pose(i).ravel()[:numbers]) for i in range(6)]
    lines = [f"{time} {row}" for time, row in zip(TIMES, rows, strict=True)] if timed else rows
    (folder / "groundtruth.txt").write_text("\n".join(lines))
    assert_right(poses_of(folder, ReadOptions()))
    if not timed:
        (folder / "groundtruth.txt").write_text("\n".join([*lines, lines[0]]))
        notes = open_recording(folder).notes
        assert any("there are only 6 colour images" in note for note in notes)
