"""Bags of ROS 1 and 2: topics, times, encodings, transforms, and what is said of those that cannot be read."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from semdb.errors import RecordingError, UsageError
from semdb.geometry import pose_error
from semdb.recordings import Recording, open_recording, parse_camera
from semdb.recordings.options import ReadOptions
from semdb.types import Camera, FloatArray
from tests.unit.bags import COLOR, DEPTH, FIRST_S, KINDS, Plan, write_bag
from tests.unit.recording_miniatures import SMALL, pose, render

OTHER = Camera(48, 40, 45.0, 45.0, 23.5, 19.5)


def assert_frames(
    recording: Recording,
    count: int = 4,
    *,
    colour: float = 0.0,
    depth: float = 6e-4,
    known: float = 1.0,
    nth: float = 100,
) -> None:
    assert [entry.index for entry in recording.entries] == list(range(count))
    for i, entry in enumerate(recording.entries):
        frame = recording.read(entry)
        image, z = render(recording.camera, pose(i))
        assert np.abs(frame.image.astype(float) - image).mean() <= colour
        assert frame.timestamp_ns == FIRST_S * 10**9 + i * 100_000_000
        assert frame.world_from_camera is not None
        assert frame.depth is not None
        assert np.isfinite(frame.depth).mean() >= known
        assert np.nanpercentile(np.abs(frame.depth - z), nth) <= depth
        assert max(pose_error(frame.world_from_camera, pose(i))) < 1e-5


@pytest.mark.parametrize("kind", KINDS)
def test_bags_of_each_kind(tmp_path: Path, kind: str) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan(kind, infrared=True)))
    assert (recording.format, recording.name, recording.camera) == ("ros_bag", "walk", SMALL)
    assert recording.dropped == ()
    assert_frames(recording)
    held = recording.contents
    color = f"{COLOR} (sensor_msgs/Image, 4, 10.0 Hz, longest pause 100 ms): colour (rgb8)"
    assert color in held
    assert any(line.startswith(f"{DEPTH} ") and line.endswith(": depth") for line in held)
    assert any(line.startswith("/tf ") and line.endswith(": poses") for line in held)
    assert "colour from /camera/color/image_raw; --color-topic takes /camera/infra1/image_raw" in recording.notes
    # the top frame of the chain is taken, and said
    chain = "(map > odom > base_link > camera_link > camera_color_optical_frame)"
    assert any(f"in 'map' {chain}" in note for note in recording.notes)


@pytest.mark.parametrize("kind", ["db3", "mcap"])
def test_a_lone_file_of_ros_2(tmp_path: Path, kind: str) -> None:
    folder = write_bag(tmp_path / "walk", Plan(kind))
    [file] = folder.glob(f"*.{kind}")
    alone = tmp_path / f"alone.{kind}"
    shutil.copy(file, alone)
    recording = open_recording(alone)
    assert recording.name == "alone"
    assert_frames(recording)


@pytest.mark.parametrize(
    ("color", "tolerance"), [("bgr8", 0), ("bgra8", 0), ("jpeg", 3), ("png", 0), ("bayer_rggb8", 4)]
)
def test_encodings_of_colour(tmp_path: Path, color: str, tolerance: float) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan("mcap", 2, color=color)))
    assert_frames(recording, 2, colour=tolerance)
    raw = recording.read(recording.entries[0]).image_bytes
    assert raw[:3] == (b"\xff\xd8\xff" if color == "jpeg" else b"\x89PN")


def test_grey_images_have_three_equal_channels(tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan("mcap", 1, color="mono8")))
    image = recording.read_image(recording.entries[0])
    np.testing.assert_array_equal(image[..., 0], render(SMALL, pose(0))[0][..., 0])
    np.testing.assert_array_equal(image[..., 0], image[..., 2])


@pytest.mark.parametrize(
    ("depth", "error"), [("32FC1", 1.1e-4), ("16UC1 png", 6e-4), ("16UC1 rvl", 6e-4), ("32FC1 png", 0.06)]
)
@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_encodings_of_depth(tmp_path: Path, depth: str, error: float, kind: str) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan(kind, 2, depth=depth)))
    assert_frames(recording, 2, depth=error)


def test_a_png_of_compressed_depth_is_kept_as_it_is(tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan("mcap", 1, depth="16UC1 png")))
    frame = recording.read(recording.entries[0])
    assert frame.depth_scale == 1000
    assert frame.depth_bytes is not None
    assert frame.depth_bytes.startswith(b"\x89PNG")


@pytest.mark.parametrize("poses", ["odometry", "pose", "path"])
def test_poses_without_tf(tmp_path: Path, poses: str) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan("bag", poses=poses)))
    assert_frames(recording)


def test_a_bag_without_poses_is_read_and_says_so(tmp_path: Path) -> None:
    recording = open_recording(write_bag(tmp_path / "walk", Plan("mcap", poses="none")))
    assert len(recording.entries) == 4
    assert all(entry.world_from_camera is None for entry in recording.entries)
    assert any("no transform moves the camera's frame 'camera_color_optical_frame'" in note for note in recording.notes)


def test_depth_of_a_camera_beside_colour_is_registered(tmp_path: Path) -> None:
    beside = np.eye(4)
    beside[:3, 3] = 0.05, 0.0, 0.0
    plan = Plan("mcap", 3, depth_camera=OTHER, color_from_depth=beside)
    recording = open_recording(write_bag(tmp_path / "walk", plan))
    assert any("depth has a camera of its own (48x40, 50.0 mm beside colour)" in note for note in recording.notes)
    assert_frames(recording, 3, depth=5e-3, known=0.55, nth=90)


def test_a_world_frame_can_be_named(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "walk", Plan("mcap", 2))
    recording = open_recording(bag, options=ReadOptions(world_frame="odom"))
    pose_in_odom = recording.entries[0].world_from_camera
    assert pose_in_odom is not None
    np.testing.assert_allclose(pose_in_odom[:3, 3], pose(0)[:3, 3] - (1, 2, 0), atol=1e-9)
    with pytest.raises(UsageError, match=r"--world-frame mapp: there is no such frame; there are base_link"):
        open_recording(bag, options=ReadOptions(world_frame="mapp"))


def test_topics_can_be_named(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "walk", Plan("mcap", 2, infrared=True))
    with pytest.raises(RecordingError, match="camera is not known"):
        open_recording(bag, options=ReadOptions(color_topic="/camera/infra1/image_raw"))
    given = open_recording(bag, parse_camera("8,8,4,4"), ReadOptions(color_topic="/camera/infra1/image_raw"))
    assert (given.camera.width, given.camera.height) == (8, 8)
    for option, value in (("color_topic", "/x"), ("depth_topic", "/x"), ("info_topic", "/x")):
        with pytest.raises(
            UsageError, match=f"--{option.replace('_', '-')} /x: .*walk has no such topic of .*; it has /"
        ):
            open_recording(bag, options=ReadOptions(**{option: value}))  # type: ignore[arg-type]
    with pytest.raises(RecordingError, match=r"color/camera_info is of 64x48 pixels, but /camera/infra1/\S+ has 8x8"):
        open_recording(
            bag, options=ReadOptions(color_topic="/camera/infra1/image_raw", info_topic="/camera/color/camera_info")
        )


def test_clocks_that_differ(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "walk", Plan("mcap", depth_delay_ms=1050))
    plain = open_recording(bag)
    assert any("no depth image lies within 20 ms of a colour image" in note for note in plain.notes)
    assert_frames(open_recording(bag, options=ReadOptions(depth_offset_ms=-1050)))


@pytest.mark.parametrize(
    ("model", "coefficients", "kept"),
    [
        ("plumb_bob", (0.1, -0.05, 0.001, -0.002, 0.01), True),
        ("rational_polynomial", (0.1, -0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0), True),
        ("equidistant", (-0.02, 0.01, 0.0, 0.0), False),
    ],
)
def test_lenses(tmp_path: Path, model: str, coefficients: tuple[float, ...], kept: bool) -> None:
    from semdb.recordings.lens import Lens

    camera = Camera(128, 96, 70.0, 70.0, 63.5, 47.5)
    kind = "fisheye" if model == "equidistant" else "radial"
    lens = Lens(128, 96, 70.0, 70.0, 63.5, 47.5, kind, coefficients)

    def through_lens(_: Camera, world_from_camera: FloatArray) -> tuple[np.ndarray, None]:
        return seen_through(lens, world_from_camera), None

    plan = Plan("bag", 2, camera, distortion_model=model, coefficients=coefficients, picture=through_lens, depth="none")
    recording = open_recording(write_bag(tmp_path / "walk", plan))
    assert bool(any(recording.camera.distortion)) == kept
    for i, entry in enumerate(recording.entries):
        image = recording.read_image(entry).astype(float)
        expected = render(recording.camera, pose(i))[0].astype(float)
        inner = np.abs(image - expected)[20:-20, 20:-20]
        assert inner.mean() < 3


def seen_through(lens: object, world_from_camera: FloatArray) -> np.ndarray:
    """The room as a camera with any lens sees it."""
    from semdb.recordings.lens import Lens
    from tests.unit.recording_miniatures import colours, room_hits

    assert isinstance(lens, Lens)
    v, u = np.mgrid[: lens.height, : lens.width]
    xy = lens.straight(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    directions = np.nan_to_num(np.column_stack([xy, np.ones(len(xy))])) @ world_from_camera[:3, :3].T
    points = world_from_camera[:3, 3] + directions * room_hits(world_from_camera[:3, 3], directions)[:, None]
    return colours(points).reshape(lens.height, lens.width, 3)


def test_a_bag_without_images_says_what_it_holds(shared_dir: Path) -> None:
    ros = shared_dir / "peers" / "ros"
    with pytest.raises(RecordingError, match=r"has no images, .* It holds /amcl_pose .*, 135\); /odom \("):
        open_recording(ros / "nav2_turtlebot.mcap")
    for name in ("tf_example.bag", "tf_example"):
        with pytest.raises(RecordingError, match=r"It holds /tf \(tf2_msgs/msg/TFMessage, 517\); /tf_static "):
            open_recording(ros / name)


def test_a_bag_of_realsense_recorder(shared_dir: Path) -> None:
    file = shared_dir / "peers" / "ros" / "realsense_single_depth_color_640x480.bag"
    recording = open_recording(file)
    assert (recording.camera.fx, recording.camera.width) == (pytest.approx(613.2037), 640)
    assert any("the nearest: 101.6 ms" in note for note in recording.notes)
    assert any("--depth-offset-ms -101.6 where" in note for note in recording.notes)
    other = open_recording(file, options=ReadOptions(depth_offset_ms=100))
    assert any("--depth-offset-ms -101.6 where" in note for note in other.notes)
    together = open_recording(file, options=ReadOptions(depth_offset_ms=-101.6))
    frame = together.read(together.entries[0])
    assert frame.depth is not None
    assert np.isfinite(frame.depth).mean() > 0.95
    assert np.nanmedian(frame.depth) == pytest.approx(1.55, abs=0.02)
    assert frame.image.shape == (480, 640, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_bags_cut_off_are_one_error_that_says_what_is_left(tmp_path: Path, kind: str) -> None:
    written = write_bag(tmp_path / "walk", Plan(kind, 3))
    file = written if kind == "bag" else next(written.glob(f"*.{kind}"))
    whole, alone = file.read_bytes(), tmp_path / f"part.{kind}"
    for share in (0.0, 0.001, 0.3, 0.9, 0.999):
        alone.write_bytes(whole[: int(share * len(whole))])
        message = refusal(alone)
        assert message.startswith(f"{alone}: ")
        if share == 0.999 and kind != "db3":
            assert "chunks" in message
            assert f"of {len(whole) - 1}" in message or "up to byte" in message


def test_an_unindexed_bag_says_how_to_index_it(tmp_path: Path) -> None:
    file = write_bag(tmp_path / "walk", Plan("bag", 3))
    data = bytearray(file.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data[at : at + 8] = bytes(8)
    file.write_bytes(data)
    with pytest.raises(RecordingError, match=r"not indexed.*chunks with 19 messages.*`rosbag reindex FILE`"):
        open_recording(file)


def test_a_damaged_image_in_a_bag_is_a_frame_that_cannot_be_decoded(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "walk", Plan("bag", 3, color="jpeg"))
    data = bag.read_bytes()
    second = data.index(b"\xff\xd8\xff", data.index(b"\xff\xd8\xff", data.index(b"\xff\xd8\xff") + 3) + 3)
    bag.write_bytes(data[: second + 200] + bytes(300) + data[second + 500 :])
    recording = open_recording(bag)
    assert [frame.index for frame in recording.frames()] == [0, 1]
    assert f"{bag}: /camera/color/image_raw/compressed #2: " in recording.decode_failures[0].reason


def refusal(path: Path) -> str:
    """The one error of a bag that cannot be read; where it can, all its frames must be readable."""
    try:
        recording = open_recording(path)
    except RecordingError as error:
        return str(error)
    for _ in recording.frames():
        pass
    return f"{path}: chunks up to byte"


def test_colour_named_as_depth_is_refused_and_a_frame_of_the_robot_is_no_world(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "walk", Plan("bag", 4))
    with pytest.raises(UsageError, match=r"--depth-topic /camera/color/image_raw: its images are no depth; .* it has "):
        open_recording(bag, options=ReadOptions(depth_topic=COLOR))
    still = open_recording(bag, options=ReadOptions(world_frame="camera_link"))
    assert "the poses of all frames are the same: the camera does not move in them" in still.notes
    assert not any("does not move" in note for note in open_recording(bag).notes)
