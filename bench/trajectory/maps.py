"""Localization on a map of estimated poses against one of recorded poses: the same keyframes, the same queries.

``python -m bench.trajectory.maps RECORDING [--keyframes N] [--queries M] [--refined DIR]``, with the models that
SEMDB_DETECTOR and SEMDB_ENCODER name. Keyframes are chosen by the recorded poses and described once; then they are
moved to the estimated ones, with their covariances, and the same queries are asked again, in colour alone.

Each map is laid on the truth by one motion, in two ways. ``world``: of the world alone, as rotations and then positions
of the keyframes say. ``world and camera``: and of the camera, one motion that all keyframes have in common. Motion
capture knows the pose of markers, and that of the camera as well as the two were calibrated; a constant error of that
is in every recorded pose, so that a map of recorded poses answers with it and is not seen to be off.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from sqlalchemy import create_engine

import semdb
from bench.trajectory.__main__ import truth_of
from semdb.database.moving import move
from semdb.database.pose_records import Move, OperationKind
from semdb.geometry import pose_from, project_to_so3, so3_log
from semdb.recordings import open_recording
from semdb.trajectory.recording import find_recorded, times_of
from semdb.types import FloatArray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--keyframes", type=int, default=40)
    parser.add_argument("--queries", type=int, default=27)
    parser.add_argument("--refined", type=Path, metavar="DIR", help="compare with refined poses, as bench.trajectory")
    given = parser.parse_args()
    recording = open_recording(given.recording)
    entries = recording.entries
    truth, _ = truth_of(recording, entries, times_of(entries)[0], given.refined)
    true = {entry.index: pose for entry, pose in zip(entries, truth, strict=True)}
    found = find_recorded(recording).trajectory
    estimated = {entries[f.position].index: f for f in found.used}
    with tempfile.TemporaryDirectory() as folder:
        url = f"sqlite:///{folder}/map.sqlite3"
        with semdb.open(url) as db:
            db.ingest(given.recording, map="map", keyframes=given.keyframes, poses="recorded", check=False)
            kept = {one.frame_index: one for one in db.keyframes("map")}
        others = [entry for entry in entries if entry.index not in kept]
        asked = [others[n] for n in np.unique(np.linspace(0, len(others) - 1, given.queries).astype(int))]
        images = [(entry.index, recording.read_image(entry), recording.camera_of(entry)) for entry in asked]
        for name in ("recorded", "estimated"):
            with semdb.open(url) as db:
                if name == "estimated":
                    frames = {one.id: estimated[index] for index, one in kept.items()}
                    map_id = next(info.id for info in db._store().maps() if info.name == "map")
                    before = {one.id: one.world_from_camera for one in kept.values()}
                    after = {key: f.world_from_camera for key, f in frames.items()}
                    spread = {key: f.covariance for key, f in frames.items()}
                    move(create_engine(url), Move(OperationKind.REFINE, map_id, before, after, covariances=spread))
                poses = {one.frame_index: one.world_from_camera for one in db.keyframes("map")}
                answers = [(index, db.localize(image, camera=camera, map="map")) for index, image, camera in images]
            localized = [(i, a.world_from_camera) for i, a in answers if a.verdict == "localized"]
            print(f"map of {name} poses: {len(localized)} of {len(answers)} localized")
            for camera in (False, True):
                laid = Laying([poses[i] for i in kept], [true[i] for i in kept], camera=camera)
                off = np.array([laid.off(pose, true[index]) for index, pose in localized if pose is not None])
                text = "world and camera" if camera else "world"
                print(f"  laid by {text:17} {np.median(off[:, 0]):.4f} m {np.median(off[:, 1]):.2f} deg (medians)")


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


if __name__ == "__main__":
    main()
