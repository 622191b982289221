"""Text files from Windows, other locales and spreadsheets give the same recording, or one line that names them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError
from semdb.recordings import Recording, open_recording
from tests.unit.recording_miniatures import SMALL, write_camera_json, write_icl, write_seven_scenes, write_tum

HOW: dict[str, Callable[[str], bytes]] = {
    "bom": lambda text: text.encode("utf-8-sig"),
    "utf16": lambda text: text.encode("utf-16"),
    "utf16 without a mark": lambda text: text.encode("utf-16-le"),
    "crlf": lambda text: text.replace("\n", "\r\n").encode(),
    "cr": lambda text: text.replace("\n", "\r").encode(),
}


def rewrite(file: Path, how: Callable[[str], bytes]) -> None:
    file.write_bytes(how(file.read_text()))


def values(line: str) -> list[str]:
    return line.split()


def rows(text: str, join: Callable[[list[str]], str]) -> bytes:
    return "\n".join(line if line.startswith("#") else join(line.split()) for line in text.splitlines()).encode()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tum(tmp_path_factory.mktemp("plain") / "walk", n=3, masks=True)


@pytest.fixture
def walk(plain: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(plain, tmp_path / "walk"))


def assert_same(found: Recording, other: Recording) -> None:
    assert found.dropped == ()
    assert (found.camera, found.depth_scale, found.categories) == (other.camera, other.depth_scale, other.categories)
    assert [e.name for e in found.entries] == [e.name for e in other.entries]
    for one, two in zip(found.entries, other.entries, strict=True):
        assert one.timestamp_ns == two.timestamp_ns
        assert one.world_from_camera is not None
        assert two.world_from_camera is not None
        np.testing.assert_allclose(one.world_from_camera, two.world_from_camera, atol=1e-8)


@pytest.mark.parametrize("file", ["rgb.txt", "depth.txt", "groundtruth.txt", "camera.json", "masks/classes.json"])
@pytest.mark.parametrize("how", HOW)
def test_every_file_of_the_tum_layout_in_every_encoding(walk: Path, plain: Path, file: str, how: str) -> None:
    rewrite(walk / file, HOW[how])
    recording = open_recording(walk)
    assert_same(recording, open_recording(plain))
    assert recording.notes == ()


@pytest.mark.parametrize(
    ("how", "note"),
    [
        (lambda text: rows(text, ",".join), False),
        (lambda text: rows(text, ", ".join), False),
        (lambda text: rows(text, ";".join), False),
        (lambda text: rows(text, lambda row: "\t".join(row) + "\t # ok"), False),
        (lambda text: rows(text, lambda row: " ".join(f"{float(value):.17e}" for value in row)), False),
        (lambda text: text.replace(".", ",").encode(), True),
        (lambda text: rows(text.replace(".", ","), "\t".join), True),
        (lambda text: rows(text.replace(".", ","), "; ".join), True),
    ],
    ids=["csv", "spaced csv", "semicolons", "comments", "exponents", "decimal commas", "tabs", "german csv"],
)
def test_ground_truth_as_spreadsheets_write_it(
    walk: Path, plain: Path, how: Callable[[str], bytes], note: bool
) -> None:
    rewrite(walk / "groundtruth.txt", how)
    recording = open_recording(walk)
    assert_same(recording, open_recording(plain))
    commas = "groundtruth.txt: numbers with decimal commas (1,5) are read as such"
    assert recording.notes == ((commas,) if note else ())


@pytest.mark.parametrize(
    "how",
    [
        lambda text: rows(text, ",".join),
        lambda text: rows(text, ";".join),
        lambda text: rows(text, lambda row: f'{row[0].replace(".", ",")} "{row[1]}"'),
        lambda text: rows(text, lambda row: " ".join(row).replace("/", "\\")),
        lambda text: rows(text, lambda row: " ".join(row) + "  # first try"),
    ],
    ids=["csv", "semicolons", "decimal commas and quotes", "backslashes", "comments"],
)
def test_lists_of_files_as_other_tools_write_them(walk: Path, plain: Path, how: Callable[[str], bytes]) -> None:
    rewrite(walk / "rgb.txt", how)
    rewrite(walk / "depth.txt", how)
    assert_same(open_recording(walk), open_recording(plain))


def test_names_with_unusual_characters_are_the_names_of_files(walk: Path, plain: Path) -> None:
    names = ["rgb/a # b.png", 'rgb/"q".png', "rgb/back\\slash.png"]
    for line, name in zip((walk / "rgb.txt").read_text().splitlines()[1:], names, strict=True):
        (walk / line.split()[1]).rename(walk / name)
    shutil.rmtree(walk / "masks")
    rewrite(
        walk / "rgb.txt",
        lambda text: "\n".join(
            f"{line.split()[0]} {name}" for line, name in zip(text.splitlines()[1:], names, strict=True)
        ).encode(),
    )
    assert [entry.name for entry in open_recording(walk).entries] == names


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("100.0 1,5 2.5 3 0 0 0 1", "has something that is no number"),
        ("100.0 " + "9" * 400 + " 0 0 0 0 0 1", "has a number that is too large"),
        ("9" * 400 + " 0 0 0 0 0 0 1", "'9999999999999999999999999999999999999999' is no time in seconds"),
        ("100.0 1e300 0 0 1e300 0 0 1", "is no rotation: the quaternion has length inf instead of 1"),
        ("100.0 0 0 0 0 0 0 \0", "has something that is no number"),
    ],
    ids=["thousands", "digits", "digits of a time", "overflow", "nul"],
)
def test_what_is_no_pose_is_left_out_and_named(walk: Path, text: str, reason: str) -> None:
    lines = (walk / "groundtruth.txt").read_text().splitlines()
    (walk / "groundtruth.txt").write_text("\n".join([text, *lines[2:]]))
    recording = open_recording(walk)
    assert len(recording.entries) == 2
    assert recording.notes[0].startswith("groundtruth.txt: 1 line(s) with unusable poses left out, the first is line 1")
    assert reason in recording.notes[0]


def test_nul_bytes_in_a_list_drop_a_frame(walk: Path) -> None:
    rewrite(walk / "rgb.txt", lambda text: text.replace("rgb/100.1", "rgb/\x00" + "100.1").encode())
    recording = open_recording(walk)
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [
        ("rgb/\x00" + "100.100000.png", "colour image: no file can have this name: it holds a NUL character")
    ]


@pytest.mark.parametrize(
    ("file", "data", "message"),
    [
        ("camera.json", b'{"width": "K\xfcche"}', r"camera\.json, line 1: is no UTF-8 text \(byte 0xfc\)"),
        ("camera.json", b"[" * 100_000, r"camera\.json: is nested too deeply"),
        ("camera.json", b'{"width": 64, "fx": ' + b"9" * 5000 + b"}", r"camera\.json: has a number that is too large"),
        ("camera.json", b"// mine\n{}", r"camera\.json, line 1: is not JSON"),
        ("masks/classes.json", b'{"1": "\\ud800"}', r"classes\.json: the class name of label 1 is no text"),
        ("masks/classes.json", b'{"' + b"9" * 5000 + b'": "cup"}', r"classes\.json: key '9{40}' must be a label"),
        ("masks/classes.json", '{"²": "cup"}'.encode(), r"classes\.json: key '²' must be a label"),
        ("groundtruth.txt", bytes(5000), r"groundtruth\.txt, line 1: "),
    ],
)
def test_files_that_cannot_be_read_are_one_line(walk: Path, file: str, data: bytes, message: str) -> None:
    (walk / file).write_bytes(data)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(walk)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500


def test_a_null_distortion_is_none(walk: Path) -> None:
    rewrite(walk / "camera.json", lambda text: text.replace("[]", "null").encode())
    assert open_recording(walk).camera == SMALL


@pytest.mark.parametrize(
    "how",
    [
        *HOW.values(),
        lambda text: text.replace(".", ",").encode(),
        lambda text: text.replace(" ", ", ").encode(),
        lambda text: " ".join(text.split()).encode(),
        lambda text: " ".join(text.split()[:12]).encode(),
        lambda text: ("# pose\n" + "\n".join(text.splitlines()[:3])).encode(),
    ],
    ids=[*HOW, "decimal commas", "csv", "one line", "12 numbers", "3 rows"],
)
def test_poses_of_seven_scenes(tmp_path: Path, how: Callable[[str], bytes]) -> None:
    folder = write_seven_scenes(tmp_path / "seq-01", n=2)
    truth = open_recording(folder).entries[1].world_from_camera
    assert truth is not None
    rewrite(folder / "frame-000004.pose.txt", how)
    found = open_recording(folder).entries[1].world_from_camera
    assert found is not None
    np.testing.assert_allclose(found, truth, atol=1e-9)


@pytest.mark.parametrize("number", ["-1.#IND000", "9" * 400, "nan", "\0"], ids=["windows", "digits", "nan", "nul"])
def test_a_pose_of_seven_scenes_that_is_none_drops_its_frame(tmp_path: Path, number: str) -> None:
    folder = write_seven_scenes(tmp_path / "seq-01", n=2)
    text = (folder / "frame-000004.pose.txt").read_text()
    (folder / "frame-000004.pose.txt").write_text(text.replace(text.split()[0], number, 1))
    [dropped] = open_recording(folder).dropped
    assert dropped.reason.startswith("frame-000004.pose.txt: has ")
    assert len(dropped.reason) < 120


@pytest.mark.parametrize("how", [*HOW.values(), lambda text: text.replace(".", ",").encode()], ids=[*HOW, "commas"])
def test_icl_nuim(tmp_path: Path, how: Callable[[str], bytes]) -> None:
    folder = write_icl(tmp_path / "traj", n=3)
    write_camera_json(folder, SMALL)
    truth = [entry.world_from_camera for entry in open_recording(folder).entries]
    rewrite(folder / "livingRoom1.gt.freiburg", how)
    if b"," not in how("."):
        rewrite(folder / "associations.txt", how)
    found = [entry.world_from_camera for entry in open_recording(folder).entries]
    assert len(found) == 2
    np.testing.assert_allclose(np.array(found), np.array(truth), atol=1e-9)


def test_numbers_of_frames_that_no_database_takes(tmp_path: Path) -> None:
    folder = write_seven_scenes(tmp_path / "seq-01", n=2)
    for kind in ("color.png", "depth.png", "pose.txt"):
        (folder / f"frame-000004.{kind}").rename(folder / f"frame-{'9' * 60}.{kind}")
    recording = open_recording(folder)
    assert [entry.index for entry in recording.entries] == [0]
    assert recording.dropped[0].reason == "its number is too large: at most 2147483647"
    icl = write_icl(tmp_path / "traj", n=3)
    write_camera_json(icl, SMALL)
    (icl / "associations.txt").write_text((icl / "associations.txt").read_text().replace("\n1 ", f"\n{'9' * 5000} "))
    assert [frame.name for frame in open_recording(icl).dropped] == ["associations.txt line 2", "rgb/0.png"]


def test_pipes_and_devices_instead_of_files(walk: Path) -> None:
    import os

    for file in ("rgb.txt", "depth.txt", "groundtruth.txt", "camera.json", "masks/classes.json"):
        data = (walk / file).read_bytes()
        (walk / file).unlink()
        os.mkfifo(walk / file)
        if file != "rgb.txt":
            with pytest.raises(RecordingError, match=f"{file}: is a named pipe, not a file"):
                open_recording(walk)
        (walk / file).unlink()
        (walk / file).write_bytes(data)
    (walk / "rgb/100.000000.png").unlink()
    os.mkfifo(walk / "rgb/100.000000.png")
    (walk / "depth/100.104000.png").unlink()
    (walk / "depth/100.104000.png").symlink_to("/dev/zero")
    recording = open_recording(walk)
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [
        ("rgb/100.000000.png", "colour image: is a named pipe, not a file"),
        ("rgb/100.100000.png", "depth image: is a device, not a file"),
    ]
    (walk / "rgb/100.200000.png").unlink()
    os.mkfifo(walk / "rgb/100.200000.png")  # between opening and decoding
    assert list(recording.frames()) == []
    assert "is a named pipe, not a file" in recording.decode_failures[0].reason
