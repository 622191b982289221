"""Localization on a map of estimated poses against one of recorded poses: the same keyframes, the same queries.

``python -m bench.trajectory.maps RECORDING [--keyframes N] [--queries M] [--refined DIR] [--json FILE]``, with the
models that SEMDB_DETECTOR and SEMDB_ENCODER name. Keyframes are chosen by the recorded poses and described once; then
they are moved to the estimated ones, with their covariances, and the same queries are asked again, in colour alone.

Recorded poses are no better than what measured them, so both maps are judged by two truths: the recorded poses, and
with ``--refined DIR`` poses that pycolmap refined (as `bench.trajectory`). By each, a map is laid on the truth by its
keyframes in two ways: ``world``, by one motion of the world, as rotations and then positions say; ``world, camera``,
by one motion of the camera, too. Motion capture knows the pose of markers, and that of the camera as well as the two
were calibrated: a constant error of that is in every recorded pose. A map of recorded poses answers with it, so that
against recorded poses it is not seen; how large it is against each truth, is printed for both maps.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from sqlalchemy import create_engine

import semdb
from bench.trajectory.__main__ import truth_of
from semdb.api import Database
from semdb.database.moving import move
from semdb.database.pose_records import Move, OperationKind
from semdb.door.values import Answer, Keyframe
from semdb.geometry import pose_from, project_to_so3, so3_log
from semdb.recordings import open_recording
from semdb.recordings.base import FrameEntry, Recording
from semdb.trajectory.recording import find_recorded, times_of
from semdb.trajectory.result import FramePose
from semdb.types import FloatArray

MAPS = ("recorded", "estimated")


@dataclass(frozen=True, slots=True)
class Reading:
    """How far answers on both maps are from one truth, as medians over the localized, and the constant motion.

    `ratio_m` and `ratio_deg` are of the estimated map to the recorded one. The constant motion, in degrees, is that of
    the camera that lays keyframes on their true poses best, found whether it is taken out or not.
    """

    truth: str
    laid_by: str
    recorded_m: float
    recorded_deg: float
    estimated_m: float
    estimated_deg: float
    ratio_m: float
    ratio_deg: float
    recorded_constant_deg: float
    estimated_constant_deg: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--keyframes", type=int, default=40)
    parser.add_argument("--queries", type=int, help="evenly spaced; all that are no keyframes where it is not given")
    parser.add_argument("--refined", type=Path, metavar="DIR", help="judge by refined poses, too, which are kept there")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    recording = open_recording(given.recording)
    truths = truths_of(recording, given.refined)
    asked = localize_on_both(recording, given.keyframes, given.queries)
    readings = [read(asked, name, truth, camera=camera) for name, truth in truths.items() for camera in (False, True)]
    show(recording.name, asked, readings)
    if given.json is not None:
        counts = {name: len(found) for name, found in asked.answers.items()}
        told = {"recording": recording.name, "keyframes": len(asked.keyframes["recorded"]), "queries": asked.queries}
        given.json.write_text(
            json.dumps({**told, "localized": counts, "readings": [asdict(one) for one in readings]}, indent=2) + "\n"
        )


def truths_of(recording: Recording, refined: Path | None) -> dict[str, dict[int, FloatArray]]:
    """True poses by frame index: the recorded ones, and refined ones."""
    entries = recording.entries
    truths = {}
    for name, folder in {"recorded": None, "refined": refined}.items():
        if name == "recorded" or folder is not None:
            poses, known = truth_of(recording, entries, times_of(entries)[0], folder)
            truths[name] = {entries[n].index: poses[n] for n in np.flatnonzero(known)}
    return truths


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """Poses of keyframes on each map, and of the queries that were localized there, by frame index."""

    queries: int
    keyframes: Mapping[str, Mapping[int, FloatArray]]
    answers: Mapping[str, Mapping[int, FloatArray]]


def localize_on_both(recording: Recording, keyframes: int, queries: int | None) -> Asked:
    found = find_recorded(recording).trajectory
    estimated = {recording.entries[f.position].index: f for f in found.used}
    keys: dict[str, Mapping[int, FloatArray]] = {}
    answers: dict[str, Mapping[int, FloatArray]] = {}
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/map.sqlite3"
        with semdb.open(url) as db:
            db.ingest(recording, map="map", keyframes=keyframes, poses="recorded", check=False)
            kept = {one.frame_index: one for one in db.keyframes("map")}
        others = [entry for entry in recording.entries if entry.index not in kept]
        rows = np.unique(np.linspace(0, len(others) - 1, queries or len(others)).astype(int))
        asked = [others[n] for n in rows]
        for name in MAPS:
            with semdb.open(url) as db:
                if name == "estimated":
                    put(url, db, kept, estimated)
                keys[name] = {one.frame_index: one.world_from_camera for one in db.keyframes("map")}
                answers[name] = answers_of(db, recording, asked)
    return Asked(len(asked), keys, answers)


def put(url: str, db: Database, kept: Mapping[int, Keyframe], estimated: Mapping[int, FramePose]) -> None:
    """Moves keyframes to where they are estimated to be."""
    frames = {one.id: estimated[index] for index, one in kept.items()}
    map_id = next(info.id for info in db._store().maps() if info.name == "map")
    before = {one.id: one.world_from_camera for one in kept.values()}
    after = {key: f.world_from_camera for key, f in frames.items()}
    spread = {key: f.covariance for key, f in frames.items()}
    move(create_engine(url), Move(OperationKind.REFINE, map_id, before, after, covariances=spread))


def answers_of(db: Database, recording: Recording, asked: Sequence[FrameEntry]) -> dict[int, FloatArray]:
    poses = {}
    for entry in asked:
        found: Answer = db.localize(recording.read_image(entry), camera=recording.camera_of(entry), map="map")
        if found.verdict == "localized" and found.world_from_camera is not None:
            poses[entry.index] = found.world_from_camera
    return poses


def read(asked: Asked, name: str, truth: Mapping[int, FloatArray], *, camera: bool) -> Reading:
    """One way of looking at the same answers."""
    medians, constant = {}, {}
    for kind in MAPS:
        keys = {index: pose for index, pose in asked.keyframes[kind].items() if index in truth}
        laid = Laying(list(keys.values()), [truth[index] for index in keys], camera=camera)
        known = {index: pose for index, pose in asked.answers[kind].items() if index in truth}
        medians[kind] = np.median([laid.off(pose, truth[index]) for index, pose in known.items()], axis=0)
        turn = Laying(list(keys.values()), [truth[index] for index in keys], camera=True).camera
        constant[kind] = float(np.degrees(np.linalg.norm(so3_log(turn))))
    recorded, estimated = medians["recorded"], medians["estimated"]
    ratio = estimated / np.maximum(recorded, 1e-12)
    return Reading(
        truth=name,
        laid_by="world, camera" if camera else "world",
        recorded_m=float(recorded[0]),
        recorded_deg=float(recorded[1]),
        estimated_m=float(estimated[0]),
        estimated_deg=float(estimated[1]),
        ratio_m=float(ratio[0]),
        ratio_deg=float(ratio[1]),
        recorded_constant_deg=constant["recorded"],
        estimated_constant_deg=constant["estimated"],
    )


class Laying:
    """The motion of a world, and of the camera if it is to, that lay keyframes on their true poses ``[n, 4, 4]``."""

    def __init__(self, poses: Sequence[FloatArray], true: Sequence[FloatArray], *, camera: bool) -> None:
        ours, theirs = np.stack(poses), np.stack(true)
        self.camera = np.eye(3)
        for _ in range(50 if camera else 1):
            turned = ours[:, :3, :3] @ self.camera
            self.world = project_to_so3((theirs[:, :3, :3] @ np.swapaxes(turned, 1, 2)).sum(axis=0))
            if camera:
                rest = np.swapaxes(self.world @ ours[:, :3, :3], 1, 2) @ theirs[:, :3, :3]
                self.camera = project_to_so3(rest.sum(axis=0))
        rest = theirs[:, :3, 3] - ours[:, :3, 3] @ self.world.T
        columns = np.concatenate([np.tile(np.eye(3), (len(ours), 1, 1)), self.world @ ours[:, :3, :3]], axis=2)
        chosen = columns if camera else columns[:, :, :3]
        found = np.linalg.lstsq(chosen.reshape(-1, chosen.shape[2]), rest.ravel(), rcond=None)[0]
        self.shift, self.beside = found[:3], np.append(found[3:], np.zeros(3))[:3]

    def off(self, pose: FloatArray, true: FloatArray) -> tuple[float, float]:
        """Metres and degrees by which a pose is off."""
        laid = pose_from(self.world, self.shift) @ pose @ pose_from(self.camera, self.beside)
        turn = laid[:3, :3].T @ true[:3, :3]
        return float(np.linalg.norm(laid[:3, 3] - true[:3, 3])), float(np.degrees(np.linalg.norm(so3_log(turn))))


def show(name: str, asked: Asked, readings: Sequence[Reading]) -> None:
    counts = ", ".join(f"{len(asked.answers[kind])} on the map of {kind} poses" for kind in MAPS)
    print(f"{name}: {len(asked.keyframes['recorded'])} keyframes; of {asked.queries} queries localized: {counts}")
    print(f"{'truth':10}{'laid by':16}{'recorded map':>20}{'estimated map':>20}{'ratios':>14}{'constant turns':>20}")
    for one in readings:
        recorded = f"{one.recorded_m:.4f} m {one.recorded_deg:.2f} deg"
        estimated = f"{one.estimated_m:.4f} m {one.estimated_deg:.2f} deg"
        constant = f"{one.recorded_constant_deg:.2f} {one.estimated_constant_deg:.2f} deg"
        ratios = f"{one.ratio_m:.2f} {one.ratio_deg:.2f}"
        print(f"{one.truth:10}{one.laid_by:16}{recorded:>20}{estimated:>20}{ratios:>14}{constant:>20}")


if __name__ == "__main__":
    main()
