"""An image inside a recording is looked up in it, and nothing beside it is looked at."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError
from semdb.geometry import pose_error
from semdb.localization.on_disk import RecordingsOnDisk
from semdb.recordings import open_recording, open_recordings
from semdb.recordings.focus import NotAmongFramesError, only_images, watched
from semdb.recordings.images import inspect_file
from tests.unit.recording_miniatures import SMALL, pose, write_camera_json, write_icl, write_seven_scenes, write_tum


@pytest.fixture
def looked_at(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the image files whose headers are read."""
    seen: list[str] = []

    def watched(path: Path) -> object:
        seen.append(path.name)
        return inspect_file(path)

    monkeypatch.setattr("semdb.recordings.assembly.inspect_file", watched)
    return seen


def test_only_the_frame_that_is_asked_for_is_looked_at(tmp_path: Path, looked_at: list[str]) -> None:
    folder = write_tum(tmp_path / "walk", n=30, masks=True)
    everything = open_recording(folder)
    assert len(looked_at) == 90
    looked_at.clear()
    found = RecordingsOnDisk().around(folder / "rgb" / "101.200000.png")
    assert found is not None
    recording, entry = found
    assert looked_at == ["101.200000.png", "101.204000.png", "101.200000.png"]  # colour, depth, masks
    wanted = everything.entries[12]
    assert (entry.index, entry.name, entry.depth_path) == (wanted.index, wanted.name, wanted.depth_path)
    assert (recording.camera, recording.categories) == (SMALL, everything.categories)
    assert entry.world_from_camera is not None
    assert max(pose_error(entry.world_from_camera, pose(12))) < 1e-6
    assert recording.read_instances(entry) is not None


def test_images_of_one_call_are_looked_up_at_once_and_remembered(tmp_path: Path, looked_at: list[str]) -> None:
    folder = write_tum(tmp_path / "walk", n=6)
    images = sorted((folder / "rgb").iterdir())
    on_disk = RecordingsOnDisk()
    indexes = [found[1].index for path in images if (found := on_disk.around(path, images[:4])) is not None]
    assert indexes == [0, 1, 2, 3, 4, 5]
    assert len(looked_at) == 2 * 6  # each once
    for path in images:
        on_disk.around(path)
    assert len(looked_at) == 2 * 6
    os.utime(folder, (1, 1))  # something in it has changed
    on_disk.around(images[0])
    assert len(looked_at) == 2 * 7


@pytest.mark.parametrize("layout", ["seven_scenes", "icl_nuim"])
def test_other_layouts(tmp_path: Path, looked_at: list[str], layout: str) -> None:
    if layout == "seven_scenes":
        folder = write_seven_scenes(tmp_path / "seq-01", n=3)
        image, index = folder / "frame-000004.color.png", 4
        for other in ("frame-000000.pose.txt", "frame-000008.pose.txt"):
            (folder / other).write_text("broken")
    else:
        folder = write_icl(tmp_path / "traj", n=4)
        write_camera_json(folder, SMALL)
        image, index = folder / "rgb" / "2.png", 2
    found = RecordingsOnDisk().around(image)
    assert found is not None
    assert found[1].index == index
    assert len(looked_at) == 2


def test_links_and_other_ways_to_an_image(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=3)
    (tmp_path / "link").symlink_to(folder)
    (folder / "rgb" / "first.png").symlink_to("100.000000.png")
    on_disk = RecordingsOnDisk()
    for path in (
        tmp_path / "link" / "rgb" / "100.100000.png",
        folder / "rgb" / ".." / "rgb" / "100.100000.png",
    ):
        found = on_disk.around(path)
        assert found is not None
        assert found[1].index == 1
    text = (folder / "rgb.txt").read_text().replace("rgb/100.000000.png", "rgb/first.png")
    (folder / "rgb.txt").write_text(text)
    found = on_disk.around(folder / "rgb" / "first.png")
    assert found is not None
    assert found[1].name == "rgb/first.png"


def test_images_of_no_recording(tmp_path: Path, looked_at: list[str]) -> None:
    folder = write_tum(tmp_path / "walk", n=3)
    shutil.copy(folder / "rgb" / "100.000000.png", folder / "rgb" / "another.png")
    said: list[str] = []
    on_disk = RecordingsOnDisk()
    assert on_disk.around(folder / "rgb" / "another.png", say=said.append) is None
    assert on_disk.around(tmp_path / "nowhere" / "a.png", say=said.append) is None
    assert (looked_at, said) == ([], [])


def test_a_recording_that_cannot_be_used_is_said(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=1)
    (folder / "camera.json").write_text("{")
    said: list[str] = []
    assert RecordingsOnDisk().around(folder / "rgb" / "100.000000.png", say=said.append) is None
    assert "the recording around" in said[0]
    assert "camera.json, line 1: is not JSON" in said[0]


def test_the_camera_of_a_recording_takes_a_look_at_a_few_frames(tmp_path: Path, looked_at: list[str]) -> None:
    folder = write_tum(tmp_path / "walk", n=60)
    like = RecordingsOnDisk().camera_like(folder)
    assert (like.camera, like.depth_scale) == (SMALL, 5000)
    assert len(looked_at) <= 2 * 20
    with pytest.raises(RecordingError, match="no such folder"):
        RecordingsOnDisk().camera_like(tmp_path / "none")


def test_nothing_is_left_of_a_wish(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=3)
    with pytest.raises(NotAmongFramesError), only_images({"none.png"}):
        open_recordings(folder)
    with only_images({"100.100000.png"}):
        assert [entry.index for entry in open_recording(folder).entries] == [1]
    assert len(open_recording(folder).entries) == 3


def test_a_broken_frame_beside_it_does_no_harm(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=3)
    (folder / "rgb" / "100.000000.png").write_bytes(b"")
    os.mkfifo(folder / "rgb" / "pipe.png")
    found = RecordingsOnDisk().around(folder / "rgb" / "100.100000.png")
    assert found is not None
    np.testing.assert_allclose(found[0].read(found[1]).world_from_camera, pose(1), atol=1e-8)
    assert RecordingsOnDisk().around(folder / "rgb" / "100.000000.png") is None


def test_whoever_opens_a_large_recording_hears_how_far_it_is(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "walk", n=3)
    for name in ("rgb.txt", "depth.txt"):
        file = (folder / name).read_text().splitlines()[1].split()[1]
        (folder / name).write_text("".join(f"{100 + k / 30:.6f} {file}\n" for k in range(700)))
    (folder / "groundtruth.txt").unlink()
    heard: list[tuple[int, int]] = []
    with watched(lambda done, total: heard.append((done, total))):
        assert len(open_recording(folder).entries) == 700
    assert heard[0] == (64, 1400)
    assert heard[-1] == (1400, 1400)
    assert [done for done, _ in heard] == sorted(done for done, _ in heard)
    heard.clear()
    with watched(lambda done, total: heard.append((done, total))):
        open_recording(write_tum(tmp_path / "small", n=3))
    assert heard == []
