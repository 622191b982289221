"""ICL-NUIM as POV-Ray rendered it: distances along rays become depth, cameras become poses and intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.geometry import pose_error
from semdb.recordings import open_recording
from semdb.recordings.cameras import ICL_NUIM
from semdb.recordings.icl_nuim import pose_from_icl
from semdb.recordings.icl_povray import along_axis
from semdb.recordings.options import ReadOptions
from tests.unit.recording_miniatures import SMALL, icl_pose, render, write_povray


@pytest.mark.parametrize(("unit", "said"), [(0.01, "centimetres"), (1.0, "metres")])
def test_distances_and_cameras_are_those_of_the_room(tmp_path: Path, unit: float, said: str) -> None:
    recording = open_recording(write_povray(tmp_path / "living_room_traj0_loop", unit=unit))
    assert (recording.format, [entry.index for entry in recording.entries]) == ("icl_povray", [0, 1, 2, 3])
    camera = recording.camera
    np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [50, 50, 31.5, 23.5], rtol=1e-6)
    assert any(f"scale: {said}, as half of scene_00_0000.depth" in line for line in recording.assumed)
    assert any("is mirrored" in line for line in recording.assumed)
    for frame in recording.frames():
        image, z = render(SMALL, icl_pose(frame.index), flip_y=True)
        assert frame.world_from_camera is not None
        assert frame.depth is not None
        assert max(pose_error(frame.world_from_camera, pose_from_icl(icl_pose(frame.index)))) < 1e-4
        np.testing.assert_array_equal(frame.image, image)
        assert np.nanmax(np.abs(frame.depth - z)) < 2e-4
        assert np.isfinite(frame.depth).mean() > 0.99


def test_a_scale_that_is_given_holds_for_positions_and_distances(tmp_path: Path) -> None:
    recording = open_recording(write_povray(tmp_path / "office"), options=ReadOptions(scale=0.005))
    frame = next(recording.frames())
    _, z = render(SMALL, icl_pose(0), flip_y=True)
    assert frame.depth is not None
    assert frame.world_from_camera is not None
    assert np.nanmax(np.abs(frame.depth - z / 2)) < 2e-4
    np.testing.assert_allclose(frame.world_from_camera[:3, 3], icl_pose(0)[:3, 3] * [0.5, -0.5, 0.5], atol=1e-5)
    assert not any("scale" in line for line in recording.assumed)
    with pytest.raises(UsageError, match="--depth-scale means nothing to a recording of format icl_povray"):
        open_recording(tmp_path / "office", options=ReadOptions(depth_scale=1000))


def test_the_data_sets_own_camera() -> None:
    """A wall at two metres: in the corner of its image the ray is 30 % longer than the depth."""
    rows, columns = np.mgrid[:480, :640]
    x, y = (columns - 319.5) / 481.2, (rows - 239.5) / 480.0
    distance = 2 * np.sqrt(1 + x * x + y * y)
    assert distance[0, 0] / 2 == pytest.approx(1.3, abs=1e-3)
    np.testing.assert_allclose(along_axis(ICL_NUIM, distance.ravel().astype(np.float32)), 2, rtol=1e-6)


def test_what_is_missing_or_broken_is_named(tmp_path: Path) -> None:
    folder = write_povray(tmp_path / "traj")
    (folder / "scene_00_0001.txt").write_text("cam_pos = [1, 2]';\n")
    (folder / "scene_00_0002.depth").unlink()
    text = (folder / "scene_00_0003.depth").read_text()
    (folder / "scene_00_0003.depth").write_text(text[: len(text) // 2].rsplit(" ", 1)[0])
    recording = open_recording(folder)
    assert [(frame.name, frame.reason) for frame in recording.dropped] == [
        ("scene_00_0001.png", "scene_00_0001.txt: has no three numbers in [1, 2]"),
        ("scene_00_0002.png", "no depth image"),
    ]
    assert [frame.index for frame in recording.frames()] == [0]
    assert "distances, but the image has 3072 pixels" in recording.decode_failures[0].reason
    (folder / "scene_00_0003.depth").write_text("one " * 3072)
    with pytest.raises(FrameError, match="has something that is no number"):
        recording.read(recording.entries[-1])
    for file in folder.glob("*.txt"):
        file.unlink()
    without = open_recording(folder, SMALL)
    assert without.entries[0].world_from_camera is None
    assert "no scene_*.txt: the frames have no pose" in without.notes
    for file in folder.glob("*.png"):
        file.unlink()
    with pytest.raises(RecordingError, match="has no images scene_00_0000"):
        open_recording(folder)


def test_cameras_that_differ_are_refused(tmp_path: Path) -> None:
    folder = write_povray(tmp_path / "traj")
    file = folder / "scene_00_0002.txt"
    file.write_text(file.read_text().replace("cam_dir      = [", "cam_dir      = [9"))
    with pytest.raises(RecordingError, match="have different focal lengths; --camera gives one"):
        open_recording(folder)
