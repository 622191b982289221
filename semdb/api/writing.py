"""Recordings to rows, and what is done to rows later."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from semdb.api.aligning import Aligning
from semdb.database.records import Deleted, RecordingStatus
from semdb.errors import CodecError, DatabaseUnavailableError, FrameError, SemdbError, UsageError

if TYPE_CHECKING:  # the rooms behind are entered when something is asked of them: they take a second to import
    from semdb.database.compacting import Compacted
    from semdb.database.copying import Copied
    from semdb.door.protocol import Source
    from semdb.evaluation.runner import EvaluateOptions, Outcome
    from semdb.ingestion.frames import FramesAdded
    from semdb.ingestion.queue import Send
    from semdb.ingestion.redescribe import Redescribed
    from semdb.ingestion.run import IngestOptions, IngestSummary, Progress
    from semdb.localization.query_image import PathText
    from semdb.recordings.arrays import CameraLike
    from semdb.recordings.base import Recording
    from semdb.recordings.options import ReadOptions
    from semdb.refinement.run import StepResult


@dataclass(frozen=True, slots=True)
class SchemaChange:
    """Revisions of the schema before (None: there was none) and now, and a server's collation where it was changed."""

    before: str | None
    now: str
    collation: str | None


class Writing(Aligning):
    """Ingests, refines and deletes."""

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
        align: bool = False,
        progress: Progress | None = None,
    ) -> list[IngestSummary]:
        """Selects keyframes, describes and stores them; running it again adds nothing, cut off it goes on.

        `source` is the folder or URL of a recording, or several, or an iterable of `Frame`, as of a live camera: these
        go to a temporary folder as they come, are one recording, and need its `name`. `keyframes` takes that many,
        those with the least common view, `stride` every stride-th frame, neither as many as it takes. `camera` and
        `reading` say of folders what their files do not. `depth_scale` is units per metre of depth files, or of those
        that are made of depth in memory (5000). `check` compares poses, depth, intrinsics and clocks with a sample of
        the images first. `poses` are ``recorded``, ``estimated`` from images and depth, or ``auto``: recorded where
        there are some. With `align` each recording is ingested into a map of its own name first, and moved into `map`
        where its images show where it lies there: `alignment` of the summary says so. `progress` is told what, done and
        total (0: not known). Makes a SQLite file that is not there.
        Returns one summary per recording.

        Raises RecordingError for what cannot be used at all or is certainly read wrongly, UsageError where models or
        plan contradict what is stored, ModelError, DatabaseError.
        """
        from semdb.api.sources import ingest_options, open_source
        from semdb.ingestion.run import ingest_opened

        options = ingest_options(map, name, keyframes, stride, camera, reading, depth_scale, check=check, poses=poses)
        if align:
            self._check_target(map)
        with open_source(source, self.settings, options, progress, self._check_ingest) as recordings:
            store = self._store(create=True)
            found: list[IngestSummary] = []
            for recording in recordings:
                mine = self._own_map(recording, options) if align else options
                with self._here.describers() as describers:
                    found += ingest_opened(
                        [recording], store, self.settings, mine, describers=describers, progress=progress, say=self._say
                    )
                if mine is not options and map is not None:
                    self._bring(found[-1], map, progress)
            return found

    def _check_target(self, map: str | None) -> None:
        if map is None:
            raise UsageError("--align needs the map to find the recording in: --map M")
        if not self.map(map).keyframes:
            raise UsageError(f"the map {map!r} holds no keyframe, so nothing can be found in it: leave out --align")

    def _own_map(self, recording: Recording, options: IngestOptions) -> IngestOptions:
        """The options to ingest a recording with, before it is aligned; `options` where it is in the map already."""
        from dataclasses import replace

        there = {one.name for one in self.recordings(options.map_name)}
        if recording.name in there:
            return options  # run again: what is left of it is done
        if recording.name == options.map_name:
            raise UsageError(
                f"the recording {recording.name!r} would be in a map of its own name first, and that is the one to "
                "find it in: give it another name with --name"
            )
        return replace(options, map_name=recording.name, like=options.map_name)

    def _bring(self, summary: IngestSummary, map: str, progress: Progress | None) -> None:
        """Aligns what was ingested into a map of its own."""
        report = self.align(summary.recording, map=map, source_map=summary.map_name, progress=progress)
        summary.alignment = report
        if report.convinced:
            summary.map_name = map

    def queue(
        self,
        paths: Sequence[PathText],
        send: Send,
        *,
        map: str | None = None,
        name: str | None = None,
        keyframes: int | None = None,
        stride: int | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        check: bool = True,
        poses: str = "auto",
        progress: Progress | None = None,
    ) -> list[IngestSummary]:
        """Plans recordings and sends their keyframes to workers by `send` (`semdb.workers.send_items`)."""
        from semdb.api.sources import ingest_options
        from semdb.ingestion.queue import queue_recordings

        options = ingest_options(map, name, keyframes, stride, camera, reading, check=check, poses=poses)
        return queue_recordings(
            [str(path) for path in paths],
            self.settings,
            options,
            send,
            store=self._store(create=True),
            progress=progress,
            say=self._say,
        )

    def resume(self, send: Send) -> int:
        """Sends all that is planned and not done to the workers again. Returns how many keyframes."""
        from semdb.ingestion.queue import sweep

        return sweep(self._store(), send, all_pending=True)

    def retry(self, map: str | None = None) -> list[tuple[RecordingStatus, int]]:
        """Puts keyframes that failed back into the plan. Returns how many of each recording of a map, or of all."""
        from semdb.database.requeue import requeue_failed

        store = self._store()
        return [
            (recording, requeue_failed(store.engine, recording.recording_id))
            for recording in store.status(self._map_id(map))
        ]

    def refine(
        self,
        map: str | None = None,
        *,
        steps: Sequence[str] = (),
        force: bool = False,
        progress: Progress | None = None,
    ) -> list[StepResult]:
        """Computes what needs more than one keyframe, where it is out of date, of a map or of all that hold keyframes.

        One map that cannot be refined keeps none of the others: its error is raised when they are done. Raises
        UsageError for a step that is none, NotFoundError, DatabaseError.
        """
        from semdb.refinement.run import refine_map, steps_of

        steps_of(steps)
        store = self._store()
        infos = [store.find_map(map)] if map is not None else [info for info in store.maps() if info.keyframes]
        results: list[StepResult] = []
        first: SemdbError | None = None
        for info in infos:
            try:
                results += refine_map(store, info, kinds=steps, force=force, progress=progress)
            except DatabaseUnavailableError:
                raise
            except SemdbError as error:
                first = first or error
        if first is not None:
            raise first
        return results

    def add_frames(
        self,
        source: str | PathLike[str] | Sequence[str | PathLike[str]],
        *,
        map: str | None = None,
        name: str | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        progress: Progress | None = None,
    ) -> list[FramesAdded]:
        """Keeps what frames beside the keyframes show, of recordings that were ingested (`semdb refine --frames`).

        `source`, `name`, `camera` and `reading` are as for `ingest`; `map` names the map where recordings are in
        several. What is there of a recording is replaced. Raises UsageError where no map holds a recording,
        RecordingError where it brings no poses or is another one, ModelError, DatabaseError.
        """
        from semdb.api.sources import ingest_options, open_source
        from semdb.ingestion.frames import add_frames, map_with
        from semdb.ingestion.run import describers_for

        options = ingest_options(map, name, None, None, camera, reading)
        found = []
        with open_source(source, self.settings, options, progress, self._check_ingest) as recordings:
            store = self._store()
            for recording in recordings:
                info = map_with(store, recording, map)
                with self._here.describers() as known:
                    has_masks = recording.categories is not None
                    _, own = describers_for(info.name, has_masks, store, self.settings, known)
                    dtype = self.settings.descriptor_dtype
                    found.append(add_frames(store, info, recording, own[0], dtype=dtype, progress=progress))
        return found

    def tell_up(self, map: str, up: Sequence[float] | None) -> None:
        """Notes which way is up in a map, for `refine` from then on; None: it is estimated again.

        Raises UsageError for what is no direction, NotFoundError.
        """
        import math

        from semdb.database.landmark_rows import LANDMARKS, give_up
        from semdb.database.refinements import forget

        length = math.hypot(*up) if up is not None else 1.0
        if not (up is None or len(up) == 3) or not 1e-6 < length < 1e6:
            raise UsageError(f"up is a direction, three numbers, not {up}")
        store = self._store()
        info = store.find_map(map)
        give_up(store.engine, info.id, None if up is None else [value / length for value in up])
        forget(store.engine, info.id, LANDMARKS)

    def delete(
        self,
        *,
        map: str | None = None,
        recording: str | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Deleted:
        """Deletes a map, a recording (of `map`, where several have one of that name) or single keyframes for good.

        Raises NotFoundError before anything is deleted, UsageError.
        """
        store = self._store()
        if keyframes is not None:
            if map is not None or recording is not None:
                raise UsageError("delete either keyframes or a recording or a map")
            wanted = sorted({int(key) for key in keyframes})
            store.check_keyframes(wanted)
            return Deleted(0, store.delete_keyframes(wanted, progress))
        if recording is not None:
            return store.delete_recording(self.recording(recording, map).recording_id, progress)
        if map is not None:
            return store.delete_map(store.find_map(map).id, progress)
        raise UsageError("say what to delete: map=, recording= or keyframes=")

    def compact(
        self,
        map: str,
        *,
        dtype: str | None = "uint8",
        keep_images: str = "original",
        dry_run: bool = False,
        progress: Callable[[int, int], None] | None = None,
    ) -> Compacted:
        """Rewrites the rows of a map smaller, a keyframe at a time; one stopped anywhere goes on where it was.

        Descriptors that take more room become `dtype` (``uint8``, ``float16``; None: as they are) and keypoints beside
        them 16 bytes each, images what `keep_images` says, as `SEMDB_KEEP_IMAGES`. Nothing of it can be taken back.
        Damaged keyframes are told of, and stay. Raises NotFoundError, UsageError.
        """
        from semdb.database.compacting import SMALLER, compact_map
        from semdb.recordings.kept_images import KINDS, ORIGINAL, kept_images

        if dtype is not None and dtype not in SMALLER:
            raise UsageError(f"descriptors become smaller as {' or '.join(SMALLER)}, not as {dtype!r}")
        if keep_images not in KINDS:
            raise UsageError(f"what is kept of images is {', '.join(KINDS)}, not {keep_images!r}")
        store = self._store()

        def kept(rgb: bytes, depth: bytes | None, name: str) -> tuple[bytes, bytes | None]:
            try:
                return kept_images(rgb, depth, keep_images, name)
            except FrameError as error:  # its keyframe stays, as one with a damaged blob
                raise CodecError(str(error)) from error

        return compact_map(
            store.engine, store.find_map(map).id, dtype, None if keep_images == ORIGINAL else kept,
            dry_run=dry_run, bad=store.left_out, progress=progress,
        )  # fmt: skip

    def redescribe(self, map: str, *, dry_run: bool = False, progress: Progress | None = None) -> Redescribed:
        """Describes all keyframes of a map anew, as a new map's are: by the encoder of the settings, or the map's own.

        The map answers from its old vectors until all are there. Cut off anywhere, another call goes on; `dry_run`
        writes nothing. Raises NotFoundError, UsageError where a keyframe cannot be read or the map is being ingested,
        RecordingError where images were not kept and the recording is gone, ModelError, DatabaseError.
        """
        from semdb.ingestion.redescribe import redescribe_map

        store = self._store()
        return redescribe_map(store, store.find_map(map), self.settings, dry_run=dry_run, progress=progress)

    def evaluate(
        self, paths: Sequence[Path], options: EvaluateOptions | None = None, *, progress: Progress | None = None
    ) -> Iterator[Outcome]:
        """How well images are localized in keyframes of recordings: see `semdb.evaluation.runner.evaluate_each`.

        Works on a database of its own beside this one, which stays as it is.
        """
        from semdb.evaluation.runner import evaluate_each

        return evaluate_each(paths, self.settings, options, progress=progress, say=self._say)

    def export(
        self,
        format: str,
        map: str,
        out: PathText,
        *,
        voxel_m: float = 0.02,
        max_depth_m: float = 8.0,
        landmarks: bool = False,
        progress: Progress | None = None,
    ) -> str:
        """Writes a map as other programs read it, or whole (`semdb`); returns a line about what was written.

        `format` is tum, colmap, kapture, landmarks, ply, mcap, g2o or semdb; `out` a file or folder that is not there.
        `voxel_m` and `max_depth_m` thin and bound a cloud; with `landmarks` it has their boxes. Raises UsageError,
        NotFoundError, DatabaseError.
        """
        from semdb.exchange.formats import export_map
        from semdb.exchange.source import ExportOptions

        options = ExportOptions(voxel_m=voxel_m, max_depth_m=max_depth_m, landmarks=landmarks)
        return export_map(self._store(), format, map, Path(out), options, progress)

    def import_map(self, folder: PathText, *, map: str | None = None, progress: Progress | None = None) -> Copied:
        """Adds a map that `export` wrote whole, under its own name or that of `map`; cut off and run again it goes on.

        Raises RecordingError for a folder that is none or is damaged, UsageError where another map
        has the name, SchemaError, DatabaseError.
        """
        from semdb.exchange.whole import import_whole

        return import_whole(Path(folder), self._store(create=True), map, progress)

    def init(self) -> SchemaChange:
        """Creates or upgrades the schema; nothing happens when it is there. Raises SchemaError, DatabaseError."""
        from semdb.database import schema
        from semdb.database.engine import make_engine

        engine = make_engine(self.settings.database_url)
        try:
            before = schema.current_revision(engine)
            return SchemaChange(before, schema.HEAD, schema.upgrade(engine))
        finally:
            engine.dispose()

    def _check_ingest(self, options: IngestOptions, has_masks: bool) -> None:
        """Loads the networks: one that is missing should not be noticed after an hour of frames."""
        from semdb.ingestion.run import describers_for

        store = self._store(create=True)
        with self._here.describers() as describers:
            describers_for(options.map_name or options.name or "", has_masks, store, self.settings, describers)
