"""Recordings that a service is to ingest, and what it is to delete."""

from __future__ import annotations

import os
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NoReturn

from semdb.client.problems import document_of, error_of
from semdb.client.tracking import TrackingCameras
from semdb.client.transport import segment
from semdb.errors import RecordingError, UsageError
from semdb.names import storable

if TYPE_CHECKING:
    from semdb.client.images import ImageReader
    from semdb.database.pose_records import PoseOperation
    from semdb.database.records import Deleted
    from semdb.door.protocol import Source
    from semdb.ingestion.run import IngestSummary
    from semdb.recordings.arrays import CameraLike
    from semdb.recordings.options import ReadOptions
    from semdb.refinement.align_report import AlignReport
    from semdb.refinement.run import StepResult
    from semdb.trajectory.recording import RecordedTrajectory
    from semdb.types import Frame, ModelInfo

Progress = Callable[[str, int, int], None]
LOOK_S = 0.5
PIECE = 2**20
OVER = frozenset(["done", "failed"])
FRAME_NS = 33_333_333  # between frames that bring no times


class Writing(TrackingCameras):
    """Ingests and deletes."""

    def close(self) -> None:
        """Lets go of the connections."""
        self._transport.close()

    def ingest(
        self,
        source: Source,
        *,
        map: str | None = None,
        name: str | None = None,
        keyframes: int | None = None,
        stride: int | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        depth_scale: float | None = None,
        check: bool = True,
        poses: str = "auto",
        upload: bool | None = None,
        progress: Progress | None = None,
    ) -> list[IngestSummary]:
        """Has recordings ingested, and waits until their keyframes are stored. See `semdb.api.Database.ingest`.

        A path that is here is sent, another one is that of a recording below the service's SEMDB_SERVE_INGEST_ROOTS;
        `upload` says which it is. Frames of an iterable are sent as they come. `progress` is told what, done and total.
        Stopping to wait does not stop the job. Of the summaries `dropped` is empty: a service tells how many only.

        Raises RecordingError for what cannot be ingested, UsageError, DatabaseError.
        """
        from semdb.ingestion.estimation import check_poses
        from semdb.recordings.arrays import as_camera, check_depth_scale
        from semdb.recordings.base import Recording as Opened

        check_poses(poses)
        scale = check_depth_scale(depth_scale)
        if reading is not None:
            others = {key for key in reading.given() if key != "depth_scale"}
            if others:
                raise UsageError(f"{', '.join(sorted(others))}: a service does not take how files are to be read")
            scale = scale or reading.depth_scale
        asked: dict[str, Any] = {"name": name, "keyframes": keyframes, "stride": stride, "poses": poses, "check": check}
        if isinstance(source, Opened):
            source = source.path
        if isinstance(source, str | PathLike):
            source = [source]
        if isinstance(source, Sequence) and source and all(isinstance(path, str | PathLike) for path in source):
            if camera is not None:
                from semdb.client.images import camera_text

                asked["camera"] = camera_text(as_camera(camera))
            asked["depth_scale"] = scale
            found: list[IngestSummary] = []
            for path in source:
                found += self._ingest_path(str(path), map, asked, upload, progress)
            return found
        if not isinstance(source, Iterable):
            raise UsageError(
                f"a folder, several, or an iterable of frames can be ingested, not {type(source).__name__}"
            )
        if camera is not None:
            raise UsageError("camera= is not for frames, which bring all of that: leave it out")
        if name is None:
            raise UsageError("frames from memory are a recording that needs a name: give name=")
        sent = self._send_frames(source, name, scale, progress)
        return self._follow(map if map is not None else name, asked | {"upload": sent}, progress)

    def _ingest_path(
        self, path: str, map: str | None, asked: dict[str, Any], upload: bool | None, progress: Progress | None
    ) -> list[IngestSummary]:
        here = Path(path)
        if upload is None:
            upload = here.exists()
            self._say(f"{path}: {'is here, so it is sent' if upload else 'is not here, so it is one of the service'}")
        name = asked["name"] or here.resolve().name.removesuffix(".zip") or "recording"
        where = map if map is not None else storable(name)
        if not upload:
            return self._follow(where, asked | {"path": storable(path)}, progress)
        with _as_one_file(here, progress) as (file, called):
            sent = self._upload(file, called, progress)
        # a folder keeps its name, whatever a service calls where it is unpacked
        return self._follow(where, asked | {"upload": sent, "name": storable(name)}, progress)

    def _upload(self, file: BinaryIO, called: str, progress: Progress | None) -> str:
        total = file.seek(0, os.SEEK_END)

        def body() -> Iterator[bytes]:
            file.seek(0)
            while piece := file.read(PIECE):
                if progress is not None:
                    progress(f"sending {called}", file.tell() // PIECE, max(1, total // PIECE))
                yield piece

        headers = {"Content-Length": str(total), "Content-Type": "application/octet-stream"}
        done = self._transport.ask(
            "POST", "/v1/uploads", again=True, params={"name": storable(called)[-100:]}, headers=headers, body=body
        )
        return str(done.json()["upload"])

    def _send_frames(self, frames: Iterable[Any], name: str, scale: float | None, progress: Progress | None) -> str:
        from semdb.recordings.memory import check_frame

        reader = self._reader(None, None, None, scale, ())
        made = self._transport.json("POST", "/v1/uploads/live", params={"name": storable(name)[-100:]})["upload"]
        for number, frame in enumerate(frames):
            self._send_frame(made, check_frame(frame), number, reader)
            if progress is not None:
                progress(f"sending frames of {name}", number + 1, 0)
        return str(made)

    def _send_frame(self, upload: str, frame: Frame, number: int, reader: ImageReader) -> None:
        from semdb.geometry import quat_wxyz_from_rotation
        from semdb.recordings.memory import DEPTH_SCALE

        sent = reader.read(frame, name=frame.name)
        time_ns = frame.timestamp_ns
        if time_ns is None:
            reader.tell("frames bring no times: 30 a second are taken")
            time_ns = number * FRAME_NS
        fields = {
            "timestamp_ns": str(time_ns),
            "camera": str(sent.camera),
            "depth_scale": repr(float(sent.depth_scale or reader.depth_scale or DEPTH_SCALE)),
        }
        pose = frame.world_from_camera
        if pose is not None:
            numbers = (*pose[:3, 3], *quat_wxyz_from_rotation(pose[:3, :3]))
            fields["pose"] = ",".join(repr(float(value)) for value in numbers)
        if sent.instances is not None:
            reader.tell("masks of frames are not sent: a service takes none of frames to ingest")
        files = {key: value for key, value in sent.files().items() if key != "instances"}
        self._transport.json("POST", f"/v1/uploads/{segment(upload)}/frames", data=fields, files=files)

    def _follow(self, map: str, asked: dict[str, Any], progress: Progress | None) -> list[IngestSummary]:
        """Begins a job and waits for its end."""
        body = {key: value for key, value in asked.items() if value is not None}
        job = self._transport.json("POST", f"/v1/maps/{segment(map)}/ingest", json=body)
        while job["state"] not in OVER:
            time.sleep(LOOK_S)
            job = self._get(f"/v1/jobs/{job['job']}")
            if progress is not None:
                _tell(job, progress)
        if job["state"] == "failed":
            raise RecordingError(f"{self.url}: job {job['job']}: {job['error']}")
        models = self.models(map)
        return [self._summary(one, models) for one in job["recordings"]]

    def _summary(self, found: dict[str, Any], models: tuple[ModelInfo, ...]) -> IngestSummary:
        from semdb.database.records import ItemState
        from semdb.ingestion.run import IngestSummary

        status = self.recording(found["recording"], found["map"])
        return IngestSummary(
            map_name=found["map"],
            recording=found["recording"],
            recording_id=status.recording_id,
            total_frames=status.frame_count + found["dropped"],
            usable_frames=status.frame_count,
            planned=found["keyframes"],
            already_stored=0,
            models=models,
            stored=status.items.get(ItemState.DONE, status.keyframes),
            objects=status.objects,
            keypoints=status.keypoints,
            failed={int(index): reason for index, reason in found["failed"].items()},
        )

    def delete(
        self,
        *,
        map: str | None = None,
        recording: str | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Callable[[int, int], None] | None = None,
        confirm: Callable[[Deleted], bool] | None = None,
    ) -> Deleted:
        """Deletes a map, a recording (of `map`, where several have it) or keyframes, for good.

        `confirm` is told before what would go of each, and says whether. Returns what is gone. Raises NotFoundError,
        UsageError.
        """
        from semdb.database.records import Deleted

        if keyframes is not None:
            if map is not None or recording is not None:
                raise UsageError("delete keyframes, or a recording or map: not both")
            paths = [f"/v1/keyframes/{int(key)}" for key in dict.fromkeys(keyframes)]
        elif recording is not None:
            found = self.recording(recording, map)
            paths = [f"/v1/maps/{segment(found.map)}/recordings/{segment(found.name)}"]
        elif map is not None:
            paths = [f"/v1/maps/{segment(map)}"]
        else:
            raise UsageError("what is to be deleted? Give map=, recording= or keyframes=")
        gone = Deleted(0, 0)
        for number, path in enumerate(paths):
            done = self._delete(path, confirm)
            gone = replace(
                gone, recordings=gone.recordings + done.recordings, keyframes=gone.keyframes + done.keyframes
            )
            if progress is not None:
                progress(number + 1, len(paths))
        return gone

    def _delete(self, path: str, confirm: Callable[[Deleted], bool] | None) -> Deleted:
        from semdb.database.records import Deleted

        first = self._transport.ask("DELETE", path, again=True, expected=(428,))
        told = document_of(first)
        if first.status_code != 428 or "confirmation" not in told:
            raise error_of(first, self.url)
        would = Deleted(told["deletes"]["recordings"], told["deletes"]["keyframes"])
        if confirm is not None and not confirm(would):
            return Deleted(0, 0)
        done = self._transport.json("DELETE", path, params={"confirm": told["confirmation"]})
        return Deleted(done["recordings"], done["keyframes"])

    def refine(
        self,
        map: str | None = None,
        *,
        steps: Sequence[str] = (),
        force: bool = False,
        progress: Progress | None = None,
    ) -> list[StepResult]:
        """Is for `semdb.open` only: raises UsageError."""
        self._not_here("refine")

    def trajectory(
        self,
        source: Source,
        *,
        every: int = 1,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        depth_scale: float | None = None,
        progress: Progress | None = None,
    ) -> RecordedTrajectory:
        """Is for `semdb.open` only, which asks no database for it: raises UsageError."""
        self._not_here("trajectory")

    def align(
        self,
        recording: str | None = None,
        *,
        map: str,
        source_map: str | None = None,
        name: str | None = None,
        joint: bool = False,
        dry_run: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> AlignReport:
        """Is for `semdb.open` only: raises UsageError."""
        self._not_here("align")

    def undo_align(self, recording: str | None = None, *, map: str | None = None) -> PoseOperation:
        """Is for `semdb.open` only: raises UsageError."""
        self._not_here("undo_align")

    def _not_here(self, what: str) -> NoReturn:
        raise UsageError(f"{what} is for semdb.open only: the service at {self.url} does not offer it")


def _tell(job: dict[str, Any], progress: Progress) -> None:
    now, items = job["progress"], job["items"]
    if now is not None:
        progress(now["what"], now["done"], now["total"])
    elif items:
        done = sum(count for state, count in items.items() if state not in ("pending", "running"))
        progress(f"ingesting into {job['map']}", done, sum(items.values()))


class _as_one_file:  # noqa: N801 (a context manager)
    """A file as it is, a folder as a zip in a temporary file, with its name. Raises RecordingError."""

    def __init__(self, path: Path, progress: Progress | None) -> None:
        self._path, self._progress = path, progress

    def __enter__(self) -> tuple[BinaryIO, str]:
        path = self._path
        try:
            if not path.is_dir():
                self._file: BinaryIO = path.open("rb")
                return self._file, path.name
            self._file = tempfile.TemporaryFile()
            self._pack(path)
        except OSError as error:
            raise RecordingError(f"{path}: cannot be sent: {error}") from error
        return self._file, f"{path.resolve().name}.zip"

    def _pack(self, folder: Path) -> None:
        name = folder.resolve().name or "recording"
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        with zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for number, path in enumerate(files):
                archive.write(path, f"{name}/{path.relative_to(folder).as_posix()}")
                if self._progress is not None:
                    self._progress(f"packing {name}", number + 1, len(files))

    def __exit__(self, *_: object) -> None:
        self._file.close()
