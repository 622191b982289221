"""What cannot be used is dropped and named with its reason, or is one clear error."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError
from semdb.recordings import Recording, open_recording, open_recordings, parse_camera
from tests.unit.recording_miniatures import SMALL, write_icl, write_image, write_seven_scenes, write_tum


def reasons(recording: Recording) -> dict[str, str]:
    assert recording.total_frames == len(recording.entries) + len(recording.dropped)
    return {frame.name: frame.reason for frame in recording.dropped}


def replace_line(path: Path, number: int, text: str) -> None:
    lines = path.read_text().splitlines()
    lines[number - 1] = text
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return write_tum(tmp_path / "walk")


def test_no_such_path_a_file_an_empty_folder_and_other_stuff(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such folder"):
        open_recording(tmp_path / "nowhere")
    (tmp_path / "file.xyz").write_text("x")
    with pytest.raises(RecordingError, match="is a file that no reader knows; known are: "):
        open_recording(tmp_path / "file.xyz")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="the folder is empty"):
        open_recording(tmp_path / "empty")
    with pytest.raises(RecordingError, match="is no recording that semdb knows; known are: ICL-NUIM"):
        open_recordings(tmp_path)


def test_what_lies_in_a_recording_names_it_and_an_image_names_the_commands_for_it(tmp_path: Path) -> None:
    walk = write_tum(tmp_path / "walk", n=1)
    for inside in (walk / "rgb", next((walk / "rgb").iterdir())):
        with pytest.raises(RecordingError, match=f"is no recording itself, but lies in one: {re.escape(str(walk))}$"):
            open_recording(inside)
    (tmp_path / "photo.JPG").write_bytes(b"")
    with pytest.raises(RecordingError, match="is an image and no recording; `semdb localize` and `semdb show` take"):
        open_recording(tmp_path / "photo.JPG")


def test_a_folder_of_recordings_names_them(tmp_path: Path) -> None:
    write_tum(tmp_path / "b", n=1)
    write_icl(tmp_path / "a", n=2)
    with pytest.raises(RecordingError, match=r"is no recording itself, but these in it are: a, b"):
        open_recording(tmp_path)


def test_tum_without_the_colour_list(walk: Path) -> None:
    (walk / "rgb.txt").unlink()
    with pytest.raises(RecordingError, match=r"rgb\.txt: the file is missing"):
        open_recording(walk)


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt", "groundtruth.txt", "camera.json"])
def test_a_link_to_nothing_is_not_taken_for_a_file_that_nobody_has(walk: Path, name: str) -> None:
    """As when the folder with the trajectories was moved."""
    (walk / name).unlink()
    (walk / name).symlink_to("/nowhere/at/all")
    with pytest.raises(RecordingError, match=f"{name}: the file is missing"):
        open_recording(walk)


def test_missing_truncated_and_text_images_are_dropped(walk: Path) -> None:
    (walk / "rgb/100.000000.png").unlink()
    data = (walk / "rgb/100.100000.png").read_bytes()
    (walk / "rgb/100.100000.png").write_bytes(data[: len(data) // 2])
    (walk / "rgb/100.200000.png").write_text("this is no image")
    (walk / "depth/100.304000.png").unlink()
    (walk / "depth/100.404000.png").write_bytes(b"")
    recording = open_recording(walk)
    assert [entry.index for entry in recording.entries] == [5]
    found = reasons(recording)
    assert found["rgb/100.000000.png"] == "colour image: the file is missing"
    assert "too early (truncated)" in found["rgb/100.100000.png"]
    assert found["rgb/100.200000.png"] == "colour image: is not a PNG or JPEG image"
    assert found["rgb/100.300000.png"] == "depth image: the file is missing"
    assert found["rgb/100.400000.png"] == "depth image: the file is empty"


def test_sizes_and_types_that_do_not_fit_are_dropped(walk: Path) -> None:
    write_image(walk / "rgb/100.000000.png", np.zeros((40, 64, 3), np.uint8))
    write_image(walk / "depth/100.104000.png", np.ones((24, 32), np.uint16))
    write_image(walk / "depth/100.204000.png", np.ones((48, 64), np.uint8))
    write_image(walk / "depth/100.304000.png", np.ones((48, 64, 3), np.uint16))
    found = reasons(open_recording(walk))
    assert found["rgb/100.000000.png"] == "colour image: 64x40 pixels instead of 64x48"
    assert found["rgb/100.100000.png"] == "depth image: 32x24 pixels instead of 64x48"
    assert found["rgb/100.200000.png"] == "depth image: 1 channel(s) of 8 bits instead of one of 16"
    assert found["rgb/100.300000.png"] == "depth image: 3 channel(s) of 16 bits instead of one of 16"


def test_images_of_another_size_than_the_known_camera(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "freiburg1_small", n=2, camera_json=False)
    with pytest.raises(RecordingError, match=r"2 of 2 images have 64x48 pixels, none the 640x480.*--camera"):
        open_recording(folder)
    assert open_recording(folder, parse_camera("50,50,31.5,23.5")).camera == SMALL


def test_times_unsorted_and_duplicate(walk: Path) -> None:
    lines = (walk / "rgb.txt").read_text().splitlines()
    swapped = [lines[0], lines[3], lines[2], lines[1], *lines[4:], "100.200000 rgb/100.100000.png"]
    (walk / "rgb.txt").write_text("\n".join(swapped))
    recording = open_recording(walk)
    assert recording.notes == ("rgb.txt: times are not in ascending order; sorted",)
    assert [entry.index for entry in recording.entries] == [0, 1, 2, 4, 5, 6]
    times = [entry.timestamp_ns or 0 for entry in recording.entries]
    assert times == sorted(times)
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [
        ("rgb/100.100000.png", "same time as rgb/100.200000.png (rgb.txt line 8)")
    ]


def test_indices_do_not_depend_on_what_can_be_used(walk: Path) -> None:
    before = {entry.name: entry.index for entry in open_recording(walk).entries}
    (walk / "rgb/100.000000.png").unlink()
    (walk / "depth/100.304000.png").write_text("text")
    after = {entry.name: entry.index for entry in open_recording(walk).entries}
    assert len(after) == 4
    assert all(before[name] == index for name, index in after.items())


def test_frames_without_depth_or_pose_within_20_ms(walk: Path) -> None:
    replace_line(walk / "depth.txt", 2, "100.021 depth/100.004000.png")
    replace_line(walk / "groundtruth.txt", 3, "100.15 0 0 0 0 0 0 1")
    found = reasons(open_recording(walk))
    assert found == {
        "rgb/100.000000.png": "no depth image within 20 ms (the nearest: 21.0 ms)",
        "rgb/100.100000.png": "no pose within 20 ms (the nearest: 50.0 ms)",
    }


def test_bad_lines_of_the_lists(walk: Path) -> None:
    replace_line(walk / "rgb.txt", 2, "noon rgb/100.000000.png")
    replace_line(walk / "depth.txt", 3, "100.104000")
    recording = open_recording(walk)
    found = reasons(recording)
    assert found["rgb.txt line 2"] == "'noon' is no time in seconds"
    assert found["rgb/100.100000.png"].startswith("no depth image within 20 ms")
    assert recording.notes == (
        "depth.txt: 1 line(s) with unusable times or names left out, the first is line 3: needs a time and a file name",
    )


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("100.1 nan 0 0 0 0 0 1", "has a number that is not finite"),
        ("100.1 0 0 0 0 0 0 0", "is no rotation: the quaternion has length 0 instead of 1"),
        ("100.1 0 0 0 1 1 0 1", "is no rotation: the quaternion has length 1.73 instead of 1"),
        ("100.1 0 0 0 0 0 1", "needs tx ty tz qx qy qz qw, but has 6 numbers"),
        ("100.1 0 0 0 0 0 x 1", "has something that is no number"),
        ("100.1 1e12 0 0 0 0 0 1", "is farther than 100000 km from the origin"),
        ("100.1 0 0 -1e300 0 0 0 1", "is farther than 100000 km from the origin"),
    ],
)
def test_unusable_poses_are_left_out_and_noted(walk: Path, line: str, reason: str) -> None:
    replace_line(walk / "groundtruth.txt", 3, line)
    recording = open_recording(walk)
    assert [frame.name for frame in recording.dropped] == ["rgb/100.100000.png"]
    assert recording.notes == (
        f"groundtruth.txt: 1 line(s) with unusable poses left out, the first is line 3: {reason}",
    )


def test_places_of_projections_of_the_earth_are_usable(walk: Path) -> None:
    lines = (walk / "groundtruth.txt").read_text().splitlines()
    moved = [" ".join([line.split()[0], "500000.25", "9900000.5", "412", *line.split()[4:]]) for line in lines[1:]]
    (walk / "groundtruth.txt").write_text("\n".join([lines[0], *moved]))
    recording = open_recording(walk)
    assert recording.dropped == ()
    assert recording.entries[0].world_from_camera is not None
    assert recording.entries[0].world_from_camera[:3, 3].tolist() == [500000.25, 9900000.5, 412.0]


def test_no_reader_lets_an_absurd_pose_pass(walk: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a layout makes of its files goes through one place, whatever it has looked at itself."""
    monkeypatch.setattr("semdb.recordings.association.FARTHEST_POSE_M", np.inf)
    line = (walk / "groundtruth.txt").read_text().splitlines()[2].split()
    replace_line(walk / "groundtruth.txt", 3, " ".join([line[0], "-1e12", *line[2:]]))
    recording = open_recording(walk)
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [
        ("rgb/100.100000.png", "its pose is farther than 100000 km from the origin")
    ]


def test_ground_truth_unsorted_and_duplicate(walk: Path) -> None:
    lines = (walk / "groundtruth.txt").read_text().splitlines()
    wrong = lines[2].split()[0] + " 9 9 9 0 0 0 1"
    (walk / "groundtruth.txt").write_text("\n".join([lines[0], *reversed(lines[1:]), wrong]))
    recording = open_recording(walk)
    assert len(recording.entries) == 6
    assert recording.entries[1].world_from_camera is not None
    np.testing.assert_allclose(recording.entries[1].world_from_camera[:3, 3], [0.05, 0.03, -0.02], atol=1e-8)
    assert recording.notes == (
        "groundtruth.txt: times are not in ascending order; sorted",
        "groundtruth.txt: 1 repeated time(s); the first pose of each is kept",
    )


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("rgb.txt", "# nothing\n", r"rgb\.txt: lists no image"),
        ("rgb.txt", "# c\nhello\n", r"rgb\.txt, line 2: needs a time and a file name"),
        ("depth.txt", "x y\n", r"depth\.txt, line 1: 'x' is no time in seconds"),
        ("groundtruth.txt", "\n\n1 2 3\n", r"groundtruth\.txt, line 3: needs tx ty tz qx qy qz qw"),
        ("groundtruth.txt", "", r"groundtruth\.txt: has no pose"),
        ("camera.json", "{\n1", r"camera\.json, line 2: is not JSON"),
        ("camera.json", "[]", r"camera\.json: must be a JSON object"),
        ("camera.json", '{"width": 64}', r"camera\.json: height, fx, fy, cx, cy missing"),
    ],
)
def test_lists_that_cannot_be_used_name_file_and_line(walk: Path, file: str, content: str, message: str) -> None:
    (walk / file).write_text(content)
    with pytest.raises(RecordingError, match=message):
        open_recording(walk)


def test_binary_lists_do_not_crash(walk: Path) -> None:
    (walk / "rgb.txt").write_bytes(bytes(range(256)) * 4)
    with pytest.raises(RecordingError, match=r"rgb\.txt, line"):
        open_recording(walk)


def test_no_frame_left_names_the_first_reason(walk: Path) -> None:
    for file in (walk / "rgb").iterdir():
        file.write_text("text")
    with pytest.raises(RecordingError, match=r"none of 6 frames can be used; the first, rgb/100.000000.png: colour"):
        open_recording(walk)


def test_masks_missing_unknown_label_or_without_classes(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "room", n=3, masks=True)
    (folder / "masks/100.000000.png").unlink()
    write_image(folder / "masks/100.100000.png", np.full((48, 64), 9, np.uint16))
    recording = open_recording(folder)
    assert reasons(recording) == {"rgb/100.000000.png": "masks: the file is missing"}
    assert [frame.index for frame in recording.frames()] == [2]
    assert "label 9 is not in masks/classes.json" in recording.decode_failures[0].reason
    (folder / "masks/classes.json").write_text('{"0": "wall"}')
    with pytest.raises(RecordingError, match=r"classes\.json: key '0' must be a label from 1 to 65535"):
        open_recording(folder)
    (folder / "masks/classes.json").unlink()
    with pytest.raises(RecordingError, match=r"classes\.json: the file is missing"):
        open_recording(folder)


def test_damage_inside_a_file_is_found_when_it_is_decoded(walk: Path) -> None:
    path = walk / "rgb/100.200000.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    recording = open_recording(walk)
    assert len(recording.entries) == 6  # header and end are fine
    for _ in range(2):  # a second pass does not count it twice
        assert [frame.index for frame in recording.frames()] == [0, 1, 3, 4, 5]
    assert [failure.name for failure in recording.decode_failures] == ["rgb/100.200000.png"]
    assert "wrong checksum" in recording.decode_failures[0].reason


def test_icl_bad_lines_and_several_ground_truths(tmp_path: Path) -> None:
    folder = write_icl(tmp_path / "traj", n=4)
    replace_line(folder / "associations.txt", 3, "2 depth/2.png")
    replace_line(folder / "livingRoom1.gt.freiburg", 3, "3 nan 0 0 0 0 0 1")
    recording = open_recording(folder, SMALL)
    assert reasons(recording) == {
        "associations.txt line 3": "needs 'N depth/N.png N rgb/N.png'",
        "rgb/0.png": "no pose for frame 0 in the ground truth",
        "rgb/3.png": "no pose for frame 3 in the ground truth",
    }
    assert "line 3: has a number that is not finite" in recording.notes[0]
    (folder / "traj.gt.freiburg").write_text("")
    with pytest.raises(RecordingError, match="several ground truths"):
        open_recording(folder, SMALL)


def test_seven_scenes_bad_poses_and_missing_parts(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq-01", n=7)
    scaled, nan = np.eye(4), np.eye(4)
    scaled[:3, :3] *= 1.5
    nan[0, 3] = np.nan
    np.savetxt(folder / "frame-000000.pose.txt", scaled)
    np.savetxt(folder / "frame-000004.pose.txt", nan)
    np.savetxt(folder / "frame-000008.pose.txt", np.diag([1, -1, 1, 1]))
    (folder / "frame-000012.pose.txt").write_text("1 0 0 0\n")
    (folder / "frame-000016.depth.png").unlink()
    (folder / "frame-000020.color.png").unlink()
    (folder / "notes.txt").write_text("something else in the folder")
    recording = open_recording(folder)
    assert [entry.index for entry in recording.entries] == [24]
    found = reasons(recording)
    assert found["frame-000000.color.png"] == (
        "frame-000000.pose.txt: is no rotation (R^T R differs from the identity by 1.2)"
    )
    assert found["frame-000004.color.png"] == "frame-000004.pose.txt: has a number that is not finite"
    assert "is no rotation" in found["frame-000008.color.png"]
    assert found["frame-000012.color.png"] == "frame-000012.pose.txt: is no matrix of 4 by 4 numbers"
    assert found["frame-000016.color.png"] == "no depth image"
    assert found["frame-000020"] == "no colour image (only frame-000020.depth.png, frame-000020.pose.txt)"
