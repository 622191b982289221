"""What programs give: arrays, files, bytes and frames, right and wrong ones."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import semdb
from semdb.errors import FrameError, NotFoundError, SchemaError, SemdbError, UsageError
from semdb.recordings import open_recording
from semdb.types import Frame
from tests.integration.opened import STRIDE, Opening, close_to, rows


def test_frames_from_memory_are_rows_like_those_of_files(open_db: Opening, room: Path, tmp_path: Path) -> None:
    """The whole database, row for row, but for what says where the frames came from."""
    told: list[tuple[str, int, int]] = []
    db = open_db()
    [summary] = db.ingest(
        open_recording(room).frames(), map="office", name="room", keyframes=6, progress=lambda *at: told.append(at)
    )
    assert summary.stored == 6
    assert told[0] == ("reading frames of room", 1, 0)
    assert ("reading frames of room", 24, 0) in told
    other = open_db(f"sqlite:///{tmp_path / 'files.sqlite3'}")
    other.ingest(room, map="office", name="room", keyframes=6)
    from_memory, from_files = rows(db), rows(other)
    assert from_memory.keys() == from_files.keys()
    for name, wanted in from_files.items():
        assert from_memory[name] == wanted, name
    [again] = db.ingest(open_recording(room).frames(), map="office", name="room", keyframes=6)
    assert (again.stored, again.already_stored) == (0, 6)
    [status] = db.recordings()
    assert (status.format, status.source, str(status.state)) == ("frames", "frames from memory", "complete")


def test_frames_of_arrays_alone(open_file: Opening, frames: list[Frame]) -> None:
    """As a live camera gives them: no file, no name, millimetres."""

    def live() -> Iterator[Frame]:
        for frame in frames:
            yield semdb.make_frame(
                frame.index,
                frame.image,
                depth=np.nan_to_num(frame.depth * 1000).astype(np.uint16),
                depth_scale=1000,
                camera=(frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy),
                world_from_camera=frame.world_from_camera,
                instances=frame.instances,
            )

    db = open_file()
    [summary] = db.ingest(live(), name="live", stride=STRIDE)
    assert (summary.map_name, summary.stored, summary.total_frames) == ("live", 6, 24)
    close_to(db.localize(frames[6]), frames[6])


@pytest.mark.parametrize(
    ("arguments", "error", "words"),
    [
        ({"source": "nowhere", "map": "m"}, SemdbError, "nowhere"),
        ({"source": []}, UsageError, "needs a name: give name="),
        ({"source": [], "name": " x"}, UsageError, "cannot be the name of a recording"),
        ({"source": [1, 2], "name": "x"}, UsageError, "frames are of semdb.Frame"),
        ({"source": [], "name": "x"}, SemdbError, "none of 0 frames can be used"),
        ({"source": 17, "name": "x"}, UsageError, "can be ingested, not int"),
        ({"source": [], "name": "x", "camera": (1, 2, 3, 4)}, UsageError, "camera= is not for frames"),
        ({"source": "ROOM", "keyframes": 0}, UsageError, "at least 1"),
        ({"source": "ROOM", "camera": (1, 2, 3)}, UsageError, "3 numbers"),
        ({"source": "ROOM", "camera": [[1, 2], [3, 4]]}, UsageError, r"shape \[2, 2\]"),
    ],
)
def test_what_cannot_be_ingested_is_refused_and_nothing_is_written(
    open_file: Opening, room: Path, arguments: dict[str, Any], error: type[Exception], words: str
) -> None:
    db = open_file()
    given = {name: room if value == "ROOM" else value for name, value in arguments.items()}
    with pytest.raises(error, match=words):
        db.ingest(given.pop("source"), **given)
    with contextlib.suppress(SchemaError):  # most are refused before there is a file
        assert db.maps() == []


def test_a_missing_detector_is_said_before_the_second_frame(open_file: Opening, frames: list[Frame]) -> None:
    asked: list[int] = []

    def live() -> Iterator[Frame]:
        for frame in frames:
            asked.append(frame.index)
            yield replace(frame, instances=None)

    with pytest.raises(UsageError, match="set SEMDB_DETECTOR"):
        open_file(detector="auto").ingest(live(), name="live")
    with pytest.raises(SemdbError, match=r"nowhere\.onnx"):
        open_file(detector="onnx:nowhere.onnx").ingest(live(), name="live")
    assert asked == [0, 0]


def test_several_images_one_answer_each(open_file: Opening, room: Path, frames: list[Frame]) -> None:
    db = open_file()
    db.ingest(room, map="office", stride=STRIDE)
    paths = sorted((room / "rgb").iterdir())
    answers = db.localize([paths[6], frames[7], str(paths[9])], map="office")
    for answer, frame in zip(answers, (frames[6], frames[7], frames[9]), strict=True):
        close_to(answer, frame)
    assert [answer.image for answer in answers] == [str(paths[6]), frames[7].name, str(paths[9])]
    assert db.localize([]) == []
    single = db.localize(paths[6], map="office", coarse="sql")
    np.testing.assert_array_equal(single.world_from_camera, answers[0].world_from_camera)
    with pytest.raises(UsageError, match="2 depth images for 1 images"):
        db.localize([paths[6]], depth=[None, None])
    with pytest.raises(UsageError, match="1 names for 2 images"):
        db.localize([paths[6], paths[7]], name=["one"])


def test_an_array_with_its_depth_and_camera(
    open_file: Opening, room: Path, frames: list[Frame], networks: dict[str, str], tmp_path: Path
) -> None:
    """All ways to give the same image, its depth and its camera have one answer, to the bit."""
    db = open_file(**networks)
    db.ingest(room, map="office", stride=STRIDE)
    frame = frames[6]
    camera = (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy)
    files = [sorted((room / kind).iterdir())[6] for kind in ("rgb", "depth")]
    raw = cv2.imread(str(files[1]), cv2.IMREAD_UNCHANGED)
    wanted = db.localize(files[0], depth=files[1], like=room, map="office")
    close_to(wanted, frame)
    ways: list[dict[str, Any]] = [
        {"image": frame.image, "depth": frame.depth, "camera": camera},
        {"image": frame.image, "depth": frame.depth, "camera": frame.camera},
        {"image": frame.image, "depth": frame.depth, "camera": frame.camera.matrix},
        {"image": frame.image, "depth": frame.depth.astype(np.float64), "like": "room"},
        {"image": frame.image, "depth": raw, "depth_scale": 5000, "camera": camera},
        {"image": frame.image, "depth": raw, "like": "room"},
        {"image": frame.image, "depth": frame.depth},  # the camera of the map's keyframes
        {"image": frame.image[..., ::-1][..., ::-1], "depth": np.asfortranarray(frame.depth), "camera": camera},
        {"image": files[0].read_bytes(), "depth": files[1].read_bytes(), "like": "room"},
        {"image": files[0], "depth": frame.depth, "camera": camera},
        {"image": replace(frame, instances=None)},
    ]
    for way in ways:
        found = db.localize(**way, map="office", name="robot 3")
        np.testing.assert_array_equal(found.world_from_camera, wanted.world_from_camera)
        np.testing.assert_array_equal(found.covariance, wanted.covariance)
        assert found.objects[0].category == "chair"
    assert db.localize(frame.image, name="robot 3").image == "robot 3"
    assert db.localize(frame.image).image == "image"
    assert [answer.image for answer in db.localize([frame.image, frame.image])] == ["image 0", "image 1"]
    grey = cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
    close_to(db.localize(grey, camera=camera), frame)


def test_recordings_that_disagree_on_the_camera(
    open_file: Opening, room: Path, frames: list[Frame], networks: dict[str, str], tmp_path: Path
) -> None:
    """A photo whose camera was plain stays so with one word more, and which word is said."""
    db = open_file(**networks)
    db.ingest(room, map="office", stride=STRIDE)
    image = frames[6].image
    close_to(db.localize(image), frames[6])
    other = shutil.copytree(room, tmp_path / "other")
    camera = json.loads((other / "camera.json").read_text())
    (other / "camera.json").write_text(json.dumps({**camera, "fx": 301.5}))
    fx, *rest = (f"{camera[name]:g}" for name in ("fx", "fy", "cx", "cy"))
    first, second = ",".join([fx, *rest]), ",".join(["301.5", *rest])

    db.ingest(other, map="attic", name="night", keyframes=2, check=False)
    with pytest.raises(FrameError) as caught:
        db.localize(image)
    assert str(caught.value) == (
        f"the camera of image (320x240) is not known: keyframes of that size have 2 cameras, {first} (recording "
        f"{room.name!r} in map 'office'), {second} (recording 'night' in map 'attic'): choose the map (map=), or give "
        "camera=(fx, fy, cx, cy), or like=RECORDING"
    )
    close_to(db.localize(image, map="office"), frames[6])
    close_to(db.localize(image, like=room.name), frames[6])

    db.ingest(other, map="office", name="night", keyframes=2, check=False)
    photo = tmp_path / "photo.png"
    cv2.imwrite(str(photo), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    with pytest.raises(FrameError) as caught:
        db.localize(photo, map="office")
    assert str(caught.value) == (
        f"the camera of {photo} (320x240) is not known: keyframes of that size have 2 cameras, {first} (recording "
        f"{room.name!r} in map 'office'), {second} (recording 'night' in map 'office'): give --camera fx,fy,cx,cy"
        "[,k1,k2,p1,p2,k3], or --like RECORDING"
    )
    with pytest.raises(FrameError, match=r"image \(100x240\) is not known: the keyframes' images are 320x240; give"):
        db.localize(image[:, :100])


def test_arrays_that_make_no_sense_are_refused(
    open_file: Opening, room: Path, frames: list[Frame], networks: dict[str, str]
) -> None:
    db = open_file(**networks)
    db.ingest(room, map="office", stride=STRIDE)
    image, depth = frames[6].image, frames[6].depth
    for given, error, words in (
        ({"image": image / np.float32(255)}, FrameError, r"image: an image has values of uint8 .* \(255 \* image\)"),
        ({"image": image[:, :100]}, FrameError, "the camera of image .100x240. is not known: .*; give camera="),
        ({"image": image, "camera": (500, 500, 160)}, UsageError, "3 numbers"),
        ({"image": image, "camera": replace(frames[6].camera, width=640)}, FrameError, "its camera is 640x240"),
        ({"image": image, "depth": depth[:100]}, FrameError, r"depth of image: depth has the shape \[100, 320\]"),
        ({"image": image, "depth": depth * 1000}, FrameError, "depth_scale=, units per metre .1000"),
        ({"image": image, "depth": (depth * 1000).astype(np.int32)}, FrameError, "give depth_scale="),
        ({"image": image, "depth": depth, "depth_scale": -1}, UsageError, "a positive number of units"),
        ({"image": image, "depth": b"png", "like": "room"}, FrameError, "depth of image"),
        ({"image": b"", "like": "room"}, FrameError, "image: the file is empty"),
        ({"image": image, "like": "attic"}, UsageError, "attic"),
        ({"image": image, "map": "attic"}, NotFoundError, "no map 'attic'"),
        ({"image": image, "coarse": "magic"}, UsageError, "magic"),
        ({"image": "nowhere.png"}, FrameError, "nowhere.png"),
        ({"image": None}, FrameError, "not NoneType"),
    ):
        with pytest.raises(error, match=words):
            db.localize(**given)
    if db.url.startswith("sqlite"):
        assert list(db.sql("SELECT COUNT(*) FROM queries")) == [(0,)]


def test_an_image_without_texture_fails_as_an_answer(open_file: Opening, room: Path, networks: dict[str, str]) -> None:
    db = open_file(**networks)
    db.ingest(room, map="office", stride=STRIDE)
    found = db.localize(np.full((240, 320, 3), 128, np.uint8))
    assert (str(found.verdict), found.localized, found.world_from_camera, found.position) == (
        "failed",
        False,
        None,
        None,
    )
    assert np.isnan(found.sigma_m)
    assert found.as_dict()["pose"] is None
    assert "failed" in repr(found)
    assert found.picture().shape[2] == 3
