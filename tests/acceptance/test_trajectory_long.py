"""Trajectories of rooms that look alike and of equal desks, and of thousands of frames: minutes each."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from bench.trajectory.closures import inject
from semdb.evaluation.trajectory_errors import trajectory_errors
from semdb.geometry import invert_pose, pose_error
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features.surf_features import SurfFeatures
from semdb.recordings.synthetic import SyntheticOptions
from semdb.recordings.synthetic.writer import SyntheticSequence
from semdb.trajectory.result import Trajectory
from semdb.trajectory.run import find_trajectory
from semdb.types import Float32Array, FloatArray, ImageArray
from tests.rooms import COMMAND, render

pytestmark = pytest.mark.long

SEED = 13


@dataclass(frozen=True, eq=False)
class Part:
    """Frames of one room; `true` ``[n, 4, 4]``."""

    pictures: list[tuple[ImageArray, Float32Array]]
    true: FloatArray


@cache
def part(frames: int, lap_frames: int, **options: int | bool) -> Part:
    sequence = SyntheticSequence(SyntheticOptions(frames=frames, lap_frames=lap_frames, noise=True, **options))  # type: ignore[arg-type]
    pictures = []
    for index in range(frames):
        seen = sequence.render(index)
        pictures.append((seen.rgb, np.where(seen.depth > 0, seen.depth, np.nan).astype(np.float32)))
    return Part(pictures, sequence.poses)


def find(parts: Sequence[Part]) -> Trajectory:
    """The trajectory of parts one after the other, as of a camera that is carried from room to room."""
    pictures = [picture for one in parts for picture in one.pictures]
    camera = SyntheticSequence(SyntheticOptions(frames=1)).camera
    return find_trajectory(
        lambda position: pictures[position],
        [camera] * len(pictures),
        np.arange(len(pictures)) / 30,
        SurfFeatures(max_keypoints=800),
        GistEncoder(),
    )


def joined_across(found: Trajectory, sizes: Sequence[int]) -> list[tuple[int, int]]:
    """Accepted closures between keyframes of different parts."""
    part_of = np.repeat(np.arange(len(sizes)), sizes)
    ends = [(edge, *(part_of[found.keyframes[n]] for n in (edge.first, edge.second))) for edge in found.closures()]
    return [(edge.first, edge.second) for edge, one, two in ends if one != two]


def room() -> Part:
    return part(60, 90, room_seed=SEED, seed=SEED)


@pytest.mark.parametrize(
    "other",
    [
        {"room_seed": SEED, "seed": SEED + 100, "alike": True},
        {"room_seed": SEED + 50, "furniture_seed": SEED, "seed": SEED + 200},
    ],
    ids=["the same shapes with other textures", "the same furniture between other walls"],
)
def test_rooms_that_look_alike_are_not_joined(other: dict[str, int | bool]) -> None:
    second = part(60, 90, **other)
    found = find([room(), second])
    assert joined_across(found, [60, 60]) == []
    assert {frame.piece for frame in found.frames[:60] if frame.placed}.isdisjoint(
        frame.piece for frame in found.frames[64:] if frame.placed
    )


def test_the_same_room_is_joined() -> None:
    again = part(60, 90, room_seed=SEED, seed=SEED + 7)
    found = find([room(), again])
    assert len(joined_across(found, [60, 60])) > 2
    assert found.pieces[0].frames > 110


def test_equal_desks_are_not_taken_for_each_other() -> None:
    desks = part(120, 80, room_seed=SEED, seed=SEED + 300, desks=5)
    found = find([desks])
    assert found.pieces[0].frames == 120
    for edge in found.closures():
        first, second = found.keyframes[edge.first], found.keyframes[edge.second]
        metres, degrees = pose_error(invert_pose(desks.true[first]) @ desks.true[second], edge.first_from_second)
        assert metres < 0.1, (first, second)
        assert degrees < 3, (first, second)
    poses = np.stack([frame.world_from_camera for frame in found.used if frame.world_from_camera is not None])
    assert trajectory_errors(poses, desks.true, np.arange(120) / 30).rmse_m < 0.01
    wrong, survived, lost = inject(found)
    assert survived == lost == 0
    assert wrong >= len(found.closures()) // 2


def test_threads_of_blas_change_nothing(tmp_path: Path) -> None:
    recording = render(tmp_path / "room", SyntheticOptions(frames=24, width=320, height=240, lap_frames=80))
    written = []
    for threads in ("1", "2"):
        out = tmp_path / f"{threads}.json"
        subprocess.run(
            [*COMMAND, "trajectory", str(recording), "--json", str(out)],
            env=os.environ | {"OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads},
            capture_output=True,
            check=True,
        )
        told = json.loads(out.read_text())
        written.append({key: told[key] for key in ("poses", "edges", "drifts", "upright")})
    assert written[0] == written[1]


MEMORY = """
import json, multiprocessing, resource
from concurrent.futures import ProcessPoolExecutor
import numpy as np

rooms = {}
def render(position):
    # 150 frames all around a room and back again, and the same of its mirror image, of its negative and of both: for a
    # camera these are other rooms, and nothing has to be rendered for them
    from semdb.recordings.synthetic import SyntheticOptions
    from semdb.recordings.synthetic.writer import SyntheticSequence
    number, index = divmod(position, 300)
    room, index = number // 4, min(index, 299 - index)
    if room not in rooms:
        rooms.clear()
        options = SyntheticOptions(frames=150, lap_frames=140, room_seed=40 + room, seed=room, noise=True)
        rooms[room] = SyntheticSequence(options), {}
    sequence, kept = rooms[room]
    assert sequence.camera.cx == (sequence.camera.width - 1) / 2
    if index not in kept:
        seen = sequence.render(index)
        kept[index] = seen.rgb, np.where(seen.depth > 0, seen.depth, np.nan).astype(np.float32)
    rgb, depth = kept[index]
    if number % 2:
        rgb, depth = rgb[:, ::-1].copy(), depth[:, ::-1].copy()
    return 255 - rgb if number % 4 > 1 else rgb, depth, sequence.camera

renderer = ProcessPoolExecutor(1, multiprocessing.get_context("fork"))
camera = renderer.submit(render, 0).result()[2]

from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.features.surf_features import SurfFeatures
from semdb.trajectory.run import find_trajectory

def read(position):
    return renderer.submit(render, position).result()[:2]

found = find_trajectory(read, [camera] * 3000, np.arange(3000) / 30, SurfFeatures(max_keypoints=800), GistEncoder())
print(json.dumps({
    "placed": sum(frame.placed for frame in found.frames), "keyframes": len(found.keyframes),
    "mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
}))
"""


def test_three_thousand_frames_take_less_than_a_gibibyte_and_a_half() -> None:
    """Ten rooms, there and back, rendered by another process, whose textures do not count."""
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    told = json.loads(done.stdout)
    assert told["placed"] > 2970
    assert told["keyframes"] > 200
    assert told["mib"] < 1536
