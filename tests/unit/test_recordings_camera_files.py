"""A camera file beside the frames is used, whatever the names of frames suggest; what nothing says is said aloud."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.errors import RecordingError, UsageError
from semdb.geometry import pose_error
from semdb.recordings import ReadOptions, open_recording, open_recordings, parse_camera
from semdb.recordings.camera_files import camera_file_names, find_camera_file
from semdb.types import Camera
from tests.unit.recording_miniatures import (
    SMALL,
    depth_units,
    pose,
    render,
    write_camera_json,
    write_icl,
    write_image,
    write_seven_scenes,
    write_tum,
)

MATRIX = "50 0 31.5\n0 50 23.5\n0 0 1\n"
SCANNET = "50 0 31.5 0\n0 50 23.5 0\n0 0 1 0\n0 0 0 1\n"
OPEN3D = json.dumps({"width": 64, "height": 48, "intrinsic_matrix": [50, 0, 0, 0, 50, 0, 31.5, 23.5, 1]})
INFO = (
    "m_colorWidth = 64\nm_colorHeight = 48\nm_depthWidth = 64\nm_depthHeight = 48\nm_depthShift = 1000\n"
    f"m_calibrationColorIntrinsic = {' '.join(SCANNET.split())}\n"
    f"m_calibrationDepthIntrinsic = {' '.join(SCANNET.split())}\n"
)


def write_fusion(folder: Path, n: int = 3) -> Path:
    """Frames named as those of 7-Scenes, but of one camera for colour, depth and poses, in millimetres."""
    for i in range(n):
        image, z = render(SMALL, pose(i))
        write_image(folder / f"frame-{i:06d}.color.png", image)
        write_image(folder / f"frame-{i:06d}.depth.png", depth_units(z, 1000))
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", pose(i))
    return folder


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camera-intrinsics.txt", MATRIX),
        ("camera-intrinsics.txt", MATRIX.replace(".", ",")),
        ("camera-intrinsics.txt", " ".join(MATRIX.split())),
        ("intrinsics.txt", "50 0 0\n0 50 0\n31.5 23.5 1\n"),  # column by column
        ("intrinsic_color.txt", SCANNET),
        ("K.txt", MATRIX),
        ("camera_intrinsic.json", OPEN3D),
        ("intrinsics.json", '{"fx": 50, "fy": 50, "cx": 31.5, "cy": 23.5}'),
        ("camera.json", OPEN3D),
        ("info.txt", INFO),
        ("_info.txt", INFO),
    ],
)
def test_frames_named_as_those_of_seven_scenes_are_of_the_camera_beside_them(
    tmp_path: Path, name: str, text: str
) -> None:
    folder = write_fusion(tmp_path / "kitchen")
    (folder / name).write_text(text)
    recording = open_recording(folder)
    assert (recording.camera, recording.depth_registration, recording.depth_scale) == (SMALL, "", 1000)
    frame = recording.read(recording.entries[2])
    assert frame.world_from_camera is not None
    assert max(pose_error(frame.world_from_camera, pose(2))) < 1e-6  # not moved to another camera
    assert frame.depth is not None
    np.testing.assert_allclose(frame.depth, render(SMALL, pose(2))[1], atol=0.0006)
    assert (name == "camera.json") == (not any(name in line for line in recording.assumed if "camera:" in line))
    assert any(line.startswith("depth scale: 1000 per metre") for line in recording.assumed) == ("info" not in name)


def test_a_camera_file_of_the_scene_is_that_of_its_sequences(tmp_path: Path) -> None:
    for number in (1, 2):
        write_fusion(tmp_path / "scene" / f"seq-0{number}", n=2)
    (tmp_path / "scene" / "camera-intrinsics.txt").write_text(MATRIX)
    found = open_recordings(tmp_path / "scene")
    assert [(recording.camera, recording.depth_registration) for recording in found] == [(SMALL, ""), (SMALL, "")]


def test_without_a_camera_file_what_the_names_stand_for_is_said(tmp_path: Path) -> None:
    recording = open_recording(write_seven_scenes(tmp_path / "seq-01"))
    assert recording.depth_registration == "7scenes"
    camera, scale = recording.assumed
    assert "7-Scenes', by the names of the files: colour camera 525,525,320,240, depth camera 585" in camera
    assert "put a camera.json beside them" in camera
    assert scale == "depth scale: 1000 per metre (that of 7-Scenes); --depth-scale gives another"
    assert recording.notes == ()
    given = open_recording(tmp_path / "seq-01", parse_camera("526,526,320,240"))
    assert "by the names of the files: depth camera 585" in given.assumed[0]


def test_a_given_camera_wins_over_the_file_but_not_over_what_it_says_of_depth(tmp_path: Path) -> None:
    folder = write_fusion(tmp_path / "kitchen")
    write_camera_json(folder, SMALL, depth_scale=2000)
    recording = open_recording(folder, parse_camera("51,51,31,23"))
    assert (recording.camera.fx, recording.depth_scale, recording.depth_registration) == (51, 2000, "")
    assert recording.assumed == ()


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("camera.yaml", "fx: 50", "camera.yaml: looks like the camera of these frames, but is of a format"),
        ("calibration.xml", "<a/>", "calibration.xml: looks like the camera of these frames, but is of a format"),
        ("calib.txt", "50 50 31.5 23.5", "but it holds 1x4 numbers, which are no matrix of intrinsics"),
        ("calib.txt", "hello", "but has something that is no number"),
        ("camera-intrinsics.txt", "50 3 31.5\n0 50 23.5\n0 0 1", "its matrix is not that of a pinhole camera"),
        ("camera-intrinsics.txt", "-50 0 31.5\n0 50 23.5\n0 0 1", "its focal lengths are not positive"),
        ("camera-intrinsics.txt", "50 0\n1 2 3", "but is no matrix of numbers"),
        ("my_camera.json", "{}", "has no fx, fy, cx, cy"),
        ("info.txt", INFO.replace("m_depthWidth = 64", "m_depthWidth = 32"), "so depth is not registered to colour"),
    ],
)
@pytest.mark.parametrize("layout", ["seven_scenes", "tum", "icl_nuim"])
def test_a_camera_file_that_cannot_be_read_refuses_every_layout(
    tmp_path: Path, name: str, text: str, message: str, layout: str
) -> None:
    if layout == "seven_scenes":
        folder = write_fusion(tmp_path / "kitchen", n=1)
    elif layout == "tum":
        folder = write_tum(tmp_path / "freiburg1_walk", n=1, camera_json=False)
    else:
        folder = write_icl(tmp_path / "traj", n=2)
    (folder / name).write_text(text)
    with pytest.raises(RecordingError, match=message) as caught:
        open_recording(folder)
    assert "write its intrinsics into a camera.json there, or give --camera" in str(caught.value)
    recording = open_recording(folder, SMALL)  # a given camera is enough, and the file is named
    assert recording.camera == SMALL
    assert any(name in note for note in recording.notes)
    write_camera_json(folder, SMALL)
    assert open_recording(folder).camera == SMALL


def test_several_camera_files_are_refused_until_one_is_camera_json(tmp_path: Path) -> None:
    folder = write_fusion(tmp_path / "kitchen", n=1)
    (folder / "intrinsic_color.txt").write_text(SCANNET)
    (folder / "intrinsic_depth.txt").write_text(SCANNET)
    with pytest.raises(RecordingError, match=r"intrinsic_color\.txt, intrinsic_depth\.txt may each be the camera"):
        open_recording(folder)
    write_camera_json(folder, SMALL)
    assert open_recording(folder).camera == SMALL


def test_other_files_are_no_cameras(tmp_path: Path) -> None:
    names = "camera_poses.txt trajectory_camera.txt cam_extrinsics.txt camera.png info.txt groundtruth.txt scam.txt"
    for name in (*names.split(), "frame-000000.pose.txt", "imu_calibration.txt", "accelerometer.txt"):
        (tmp_path / name).write_text("1 2 3")
    assert camera_file_names(tmp_path) == []
    assert find_camera_file(tmp_path, tmp_path / "none") is None


def test_icl_nuim_takes_camera_json_and_says_what_it_assumes(tmp_path: Path) -> None:
    folder = write_icl(tmp_path / "traj", n=3)
    write_camera_json(folder, SMALL, depth_scale=5000)
    recording = open_recording(folder)
    assert (recording.camera, recording.depth_scale) == (SMALL, 5000)
    assert recording.assumed == ("poses: *.gt.freiburg is left-handed with y up, as ICL-NUIM's, and is mirrored",)
    (folder / "camera.json").unlink()
    big = [
        cv2.resize(cv2.imread(str(file), -1), (640, 480), interpolation=0) for file in sorted(folder.glob("*/*.png"))
    ]
    for file, image in zip(sorted(folder.glob("*/*.png")), big, strict=True):
        cv2.imwrite(str(file), image)
    assert [line.split(" (")[0] for line in open_recording(folder).assumed] == [
        "camera: that of ICL-NUIM, 481.2,480,319.5,239.5",
        "poses: *.gt.freiburg is left-handed with y up, as ICL-NUIM's, and is mirrored",
        "depth scale: 5000 per metre",
    ]


def test_every_assumed_depth_scale_of_tum_is_said(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=2, camera_json=False)
    scale = "depth scale: 5000 per metre (that of TUM RGB-D); --depth-scale gives another"
    recording = open_recording(folder, SMALL)
    assert recording.said == (scale,)
    content = {key: getattr(SMALL, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps(content))
    assert open_recording(folder).said == (
        "depth scale: 5000 per metre (camera.json does not say it); --depth-scale gives another",
    )
    (folder / "camera.json").write_text(json.dumps(content | {"depth_scale": 2500}))
    assert open_recording(folder).said == ()
    given = open_recording(folder, options=ReadOptions(depth_scale=1000))
    assert (given.depth_scale, given.said) == (1000, ())
    (folder / "depth.txt").unlink()
    (folder / "camera.json").write_text(json.dumps(content))
    assert open_recording(folder).assumed == ()  # no depth, no scale
    name = write_tum(
        tmp_path / "freiburg1_x", n=1, camera=Camera(640, 480, 517.3, 516.5, 318.6, 255.3), camera_json=False
    )
    assert "camera: that of the Kinect which the folder's name 'freiburg1_x' stands for" in open_recording(name).assumed


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"fx": 0.78, "fy": 1.04, "cx": 0.49, "cy": 0.49},
            "divided by the image's size they would be 49.92,49.92,31.36",
        ),
        ({"fx": 12.7}, "fx is 12.7 pixels, which no camera with images of 64x48 has: from 12.8 to 1280 make sense"),
        ({"fy": 1281}, "fy is 1281 pixels"),
        ({"cx": 63}, r"the principal point \(63, 23.5\) is not inside the images of 64x48"),
        ({"cx": 63.5, "cy": 47.5}, "are these the intrinsics of images 2 times as large"),
        ({"cx": 0, "cy": 0}, "is not inside the images"),
        ({"cy": -119.5}, "is not inside the images"),
        ({"distortion": [-1, 0, 0, 0]}, r"the distortion -1, 0, 0, 0 folds \d+% of an image of 64x48"),
        ({"distortion": [1e6, 0, 0, 0]}, "moves pixels of an image of 64x48 by a factor of"),
        ({"distortion": [1e300, 0, 0, 0]}, "folds 100%"),
        ({"depth_scale": 0.001}, "a depth scale of 0.001 units per metre makes no sense .* are 1000 units per metre"),
        ({"depth_scale": 1}, "a depth scale of 1 units per metre makes no sense"),
        ({"depth_scale": 1e7}, "makes no sense"),
    ],
)
def test_impossible_values_are_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    content = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(content | change))
    with pytest.raises(RecordingError, match=message):
        open_recording(folder)
    if "depth_scale" not in change:  # and so is the same as an option
        numbers = content | change
        values = [*(numbers[key] for key in ("fx", "fy", "cx", "cy")), *numbers["distortion"]]
        with pytest.raises(UsageError, match=f"^--camera: .*{message}"):
            open_recording(folder, parse_camera(",".join(map(str, values))))


@pytest.mark.parametrize("scale", [0.001, 1, 9, 1e7])
def test_impossible_depth_scales_are_usage_errors(tmp_path: Path, scale: float) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    with pytest.raises(UsageError, match=r"--depth-scale: a depth scale of .* makes no sense"):
        open_recording(folder, options=ReadOptions(depth_scale=scale))


@pytest.mark.parametrize(
    ("text", "doubt"),
    [
        ("50,31.5,50,23.5", "the order is fx, fy, cx, cy"),
        ("50,50,47,24", "is far from the centre"),
        ("50,50,31.5,23.5,-0.02,0.05,-0.06,0.03", "the k1 to k4 of a fisheye model are something else"),
    ],
)
def test_unlikely_values_are_said(tmp_path: Path, text: str, doubt: str) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    assert any(doubt in line for line in open_recording(folder, parse_camera(text)).assumed)


def test_decimal_commas_of_a_camera_are_named(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    with pytest.raises(UsageError, match="were these decimal commas"):
        open_recording(folder, parse_camera("50,4,50,4,31,5,23,5"))
    shutil.rmtree(folder)


@pytest.mark.parametrize("depth_first", [False, True])
def test_associations_with_times_are_of_the_tum_layout(tmp_path: Path, depth_first: bool) -> None:
    folder = write_tum(tmp_path / "walk", n=3)
    plain = open_recording(folder)
    lists = [
        [line for line in (folder / name).read_text().splitlines() if line[0] != "#"]
        for name in ("rgb.txt", "depth.txt")
    ]
    if depth_first:
        lists.reverse()
    text = "# rgb and depth\n" + "\n".join(" ".join(pair) for pair in zip(*lists, strict=True)) + "\n1 2 3\n"
    (folder / "associations.txt").write_text(text)
    (folder / "rgb.txt").unlink()
    (folder / "depth.txt").unlink()
    found = open_recording(folder)
    assert (found.format, found.total_frames) == ("tum", 4)
    assert [(e.index, e.name, e.timestamp_ns, e.depth_path) for e in found.entries] == [
        (e.index, e.name, e.timestamp_ns, e.depth_path) for e in plain.entries
    ]
    assert [(frame.name, frame.reason) for frame in found.dropped] == [
        ("associations.txt line 5", "needs 'time rgb/NAME time depth/NAME'")
    ]
