"""Models of COLMAP and data sets of kapture as recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.geometry import pose_error
from semdb.recordings import open_recording
from semdb.recordings.colmap_files import MODELS, lens_of, model_folder, read_model
from semdb.recordings.options import ReadOptions
from tests.unit.model_files import UNIT_M, write_colmap, write_kapture
from tests.unit.recording_miniatures import SMALL, pose, render

METRES = ReadOptions(scale=UNIT_M)


@pytest.mark.parametrize("binary", [False, True])
@pytest.mark.parametrize("own_cameras", [False, True])
def test_colmap(tmp_path: Path, binary: bool, own_cameras: bool) -> None:
    folder = write_colmap(tmp_path / "room", binary=binary, own_cameras=own_cameras)
    recording = open_recording(folder, options=METRES)
    cameras = 4 if own_cameras else 1
    assert recording.contents == (
        f"4 images of {cameras} cameras, 2 points, 2 observations, mean reprojection error 1.000 px",
    )
    assert (recording.format, recording.total_frames) == ("colmap", 4)
    assert [entry.index for entry in recording.entries] == [10, 11, 12, 13]
    for i, frame in enumerate(recording.frames()):
        assert frame.depth is None
        assert frame.world_from_camera is not None
        assert frame.camera.fx == SMALL.fx + (i if own_cameras else 0)
        assert (frame.camera.cx, frame.camera.cy) == (SMALL.cx, SMALL.cy)  # half a pixel less than in the file
        np.testing.assert_array_equal(frame.image, render(frame.camera, pose(i))[0])
        assert max(pose_error(frame.world_from_camera, pose(i))) < 1e-6
    assert "has no depth" in recording.notes[0]


def test_the_scale_of_a_colmap_model_is_asked_for(tmp_path: Path) -> None:
    folder = write_colmap(tmp_path / "room")
    with pytest.raises(UsageError, match="a model of COLMAP has no scale: give --scale N"):
        open_recording(folder)
    metric = write_colmap(tmp_path / "metric", metric=True)
    assert max(pose_error(open_recording(metric).entries[2].world_from_camera, pose(2))) < 1e-6  # type: ignore[arg-type]


def test_a_colmap_model_without_images_says_what_it_holds(shared_dir: Path) -> None:
    with pytest.raises(
        RecordingError, match=r"'DSC_5283.jpg' .*23 cameras, 1443 points, 5931 observations, .* 0.848 px"
    ):
        open_recording(shared_dir / "peers" / "colmap")


def test_colmap_models_as_pycolmap_reads_them(shared_dir: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = shared_dir / "peers" / "colmap" / "sparse" / "0"
    ours, theirs = read_model(folder), pycolmap.Reconstruction(folder)
    assert set(ours.images) == set(theirs.images)
    for image_id, image in theirs.images.items():
        assert ours.images[image_id].name == image.name
        np.testing.assert_allclose(
            ours.images[image_id].camera_from_world[:3], image.cam_from_world().matrix(), atol=1e-12
        )
        assert ours.images[image_id].points == image.num_points3D
    for camera_id, camera in theirs.cameras.items():
        assert ours.lenses[camera_id].fx == camera.focal_length_x
        assert ours.lenses[camera_id].cx == camera.principal_point_x - 0.5


@pytest.mark.parametrize(
    "name", ["SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"]
)
def test_lenses_see_as_pycolmaps(name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    values = {"f": 500, "fx": 500, "fy": 510, "cx": 320.5, "cy": 240.5, "k1": -0.1, "k2": 0.03, "p1": 1e-3, "p2": -2e-3}
    values |= {"k3": 0.01, "k4": -0.02, "k5": 0.01, "k6": 0.003}
    parameters = [float(values[key]) for key in MODELS[name][1]]
    lens = lens_of(name, 640, 480, parameters)
    camera = pycolmap.Camera(model=name, width=640, height=480, params=parameters)
    rays = np.array([[0.1, 0.2, 1.0], [-0.3, 0.1, 1.0], [0.25, -0.35, 1.0]])
    expected = np.array([camera.img_from_cam(ray) for ray in rays]).reshape(3, 2)
    np.testing.assert_allclose(lens.seen(rays[:, :2]) + 0.5, expected, atol=1e-9)


@pytest.mark.parametrize("binary", [False, True])
def test_colmap_files_cut_off(tmp_path: Path, binary: bool) -> None:
    folder = write_colmap(tmp_path / "room", binary=binary)
    model = model_folder(folder)
    assert model is not None
    for name in ("cameras", "images", "points3D"):
        file = model / f"{name}{'.bin' if binary else '.txt'}"
        whole = file.read_bytes()
        for length in range(0, len(whole), 7):
            file.write_bytes(whole[:length])
            message = refusal(folder)
            assert not message or name in message or "room" in message
        file.write_bytes(whole)


def refusal(folder: Path) -> str:
    try:
        open_recording(folder, options=METRES)
    except (RecordingError, UsageError) as error:
        return str(error)
    return ""


@pytest.mark.parametrize(("rig", "beside"), [(True, False), (False, False), (True, True)])
def test_kapture(tmp_path: Path, rig: bool, beside: bool) -> None:
    recording = open_recording(write_kapture(tmp_path / "room", rig=rig, beside=beside))
    assert recording.contents == ("2 sensors, 4 poses, 4 records of images, 4 of depth",)
    assert (recording.format, [entry.index for entry in recording.entries]) == ("kapture", [0, 1, 2, 3])
    for i, frame in enumerate(recording.frames()):
        image, z = render(SMALL, pose(i))
        assert frame.camera == SMALL
        assert frame.depth is not None
        assert frame.world_from_camera is not None
        assert frame.timestamp_ns is None
        np.testing.assert_array_equal(frame.image, image)
        assert np.isfinite(frame.depth).mean() > (0.9 if beside else 0.999)
        assert np.nanpercentile(np.abs(frame.depth - z), 90) < (2e-3 if beside else 1.1e-4)
        assert max(pose_error(frame.world_from_camera, pose(i))) < 1e-6


def test_kapture_with_what_is_missing(tmp_path: Path) -> None:
    folder = write_kapture(tmp_path / "room")
    (folder / "sensors" / "records_data" / "2.depth").write_bytes(bytes(5))
    (folder / "sensors" / "records_data" / "1.depth").unlink()
    lines = (folder / "sensors" / "trajectories.txt").read_text().splitlines()
    (folder / "sensors" / "trajectories.txt").write_text("\n".join(lines[:-1]))
    recording = open_recording(folder)
    assert {frame.name: frame.reason for frame in recording.dropped} == {
        "cam/1.png": "no depth of the same time",
        "cam/3.png": "no pose of rgb at 3",
    }
    with pytest.raises(FrameError, match="has 5 bytes, but 64x48 float32 have 12288"):
        recording.read(recording.entries[1])
    (folder / "sensors" / "rigs.txt").write_text("r, rgb, 1, 0\n")
    with pytest.raises(RecordingError, match=r"rigs.txt, line 1: needs 9 values between commas, but has 4"):
        open_recording(folder)


def test_a_data_set_of_kapture_without_images_says_what_it_holds(shared_dir: Path) -> None:
    with pytest.raises(RecordingError, match=r"none of the 3 images .* 3 sensors, 3 poses, .*, 6 of depth"):
        open_recording(shared_dir / "peers" / "kapture" / "stairs_seq-01")


def test_a_real_data_set_of_kapture_with_black_images(tmp_path: Path, shared_dir: Path) -> None:
    """Its depth, rig and poses are read; black images stand for those that are not there."""
    import shutil

    import cv2

    source = shared_dir / "peers" / "kapture" / "stairs_seq-01"
    shutil.copytree(source, tmp_path / "stairs", copy_function=shutil.copyfile)
    for file in [tmp_path / "stairs", *(tmp_path / "stairs").rglob("*")]:
        file.chmod(0o755)
    data = tmp_path / "stairs" / "sensors" / "records_data"
    (data / "seq-01").mkdir()
    for i in range(3):
        cv2.imwrite(str(data / f"frame-{i:06d}.color.jpg"), np.zeros((480, 640, 3), np.uint8))
        shutil.move(data / f"frame-{i:06d}.depth", data / "seq-01" / f"frame-{i:06d}.depth")
    recording = open_recording(tmp_path / "stairs")
    frames = list(recording.frames())
    assert len(frames) == 3
    for frame in frames:
        assert frame.depth is not None
        assert np.isfinite(frame.depth).mean() > 0.5
        assert 0.5 < np.nanmedian(frame.depth) < 5
    assert recording.trajectory_length() < 0.02
