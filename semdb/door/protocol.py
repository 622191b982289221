"""What a program can ask, wherever the database is: on this machine (`semdb.open`), or behind a service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias, overload

if TYPE_CHECKING:
    from datetime import datetime

    from semdb.database.jobs import Job
    from semdb.database.landmark_reading import StoredLandmark, StoredRelation
    from semdb.database.landmark_records import LandmarkVisit
    from semdb.database.pose_records import PoseOperation
    from semdb.database.query_log import LoggedQuery, QueryFilter
    from semdb.database.records import Deleted, FailedItem, MapInfo, RecordingStatus, StoredImage
    from semdb.database.scene_reading import StoredSighting
    from semdb.door.changed import Changes
    from semdb.door.found import Found
    from semdb.door.links import KeyframeLink
    from semdb.door.tracked import Tracked
    from semdb.door.values import Answer, Keyframe, Rows
    from semdb.ingestion.run import IngestSummary
    from semdb.localization.coverage import Coverage
    from semdb.localization.query_image import Depth, Image, PathText
    from semdb.pictures.cloud import Cloud
    from semdb.recordings.arrays import CameraLike
    from semdb.recordings.base import Recording
    from semdb.recordings.options import ReadOptions
    from semdb.refinement.align_report import AlignReport
    from semdb.refinement.run import StepResult
    from semdb.trajectory.recording import RecordedTrajectory
    from semdb.types import FloatArray, Frame, ModelInfo

    Source: TypeAlias = PathText | Sequence[PathText] | Recording | Iterable[Frame]


class CameraTracker(Protocol):
    """One camera in one map; see `semdb.api.tracking.MapTracker`."""

    @property
    def map(self) -> str: ...

    def update(
        self,
        image: Image,
        *,
        time_s: float | None = None,
        depth: Depth | None = None,
        odometry: FloatArray | None = None,
        name: str | None = None,
    ) -> Tracked: ...


class SemanticDatabase(Protocol):
    """Maps, recordings and keyframes, and images to poses in them; see `semdb.api.Database` for what each takes.

    Every method raises a child of `SemdbError` that says what to do. Close it, or use it in a ``with``.
    """

    def __enter__(self) -> Self: ...

    def __exit__(self, *_: object) -> None: ...

    def close(self) -> None: ...

    @property
    def url(self) -> str: ...

    def maps(self) -> list[MapInfo]: ...

    def map(self, name: str) -> MapInfo: ...

    def models(self, map: str) -> tuple[ModelInfo, ...]: ...

    def recordings(self, map: str | None = None) -> list[RecordingStatus]: ...

    def recording(self, name: str, map: str | None = None) -> RecordingStatus: ...

    def keyframe(self, keyframe_id: int) -> Keyframe: ...

    def keyframes(
        self,
        map: str | None = None,
        recording: str | None = None,
        *,
        ids: Iterable[int] | None = None,
        after: int = 0,
        limit: int | None = None,
    ) -> list[Keyframe]: ...

    def check(self) -> None: ...

    def check_keyframes(self, ids: Iterable[int]) -> None: ...

    def has_recording(self, name: str, map: str | None = None) -> bool: ...

    def keyframe_files(self, keyframe_id: int) -> StoredImage: ...

    def loops(
        self,
        map: str | None = None,
        *,
        odometry: bool = False,
        after: tuple[int, int, str] | None = None,
        limit: int | None = None,
    ) -> list[KeyframeLink]: ...

    def landmarks(
        self,
        map: str,
        *,
        category: str | None = None,
        state: str | None = None,
        after: int = 0,
        limit: int | None = None,
    ) -> list[StoredLandmark]: ...

    def relations(
        self,
        map: str,
        *,
        kind: str | None = None,
        landmark: int | None = None,
        after: tuple[int, int, str] | None = None,
        limit: int | None = None,
    ) -> list[StoredRelation]: ...

    def up(self, map: str) -> tuple[float, float, float] | None: ...

    def coverage(self, map: str, position: Sequence[float] | None = None, *, radius_m: float = 2.0) -> Coverage: ...

    def sightings(self, map: str, landmark: int) -> list[StoredSighting]: ...

    def visits(self, map: str, landmark: int) -> list[LandmarkVisit]: ...

    def seen_in(self, keyframe_id: int) -> list[StoredSighting]: ...

    def scene(self, map: str) -> dict[str, Any]: ...

    def cloud(self, map: str, points: int = 100_000) -> Cloud: ...

    def changes(self, before: str, after: str, map: str | None = None) -> Changes: ...

    def queries(
        self, map: str, *, before: int | None = None, limit: int = 100, wanted: QueryFilter | None = None
    ) -> list[LoggedQuery]: ...

    def query(self, query_id: int) -> tuple[str, LoggedQuery]: ...

    def failures(self, recording: str, map: str) -> list[FailedItem]: ...

    def job(self, job_id: int) -> Job: ...

    def jobs(self, map: str | None = None, *, before: int | None = None, limit: int = 100) -> list[Job]: ...

    def tables(self) -> dict[str, tuple[str, ...]]: ...

    def find(
        self,
        what: str,
        *,
        near: str | None = None,
        on: str | None = None,
        not_near: str | None = None,
        map: str | None = None,
        seen_after: str | int | datetime | None = None,
        origin: Sequence[float] | None = None,
        limit: int = 10,
    ) -> Found: ...

    def sql(self, statement: str) -> Rows: ...

    @overload
    def localize(
        self,
        image: Image,
        *,
        map: str | None = None,
        depth: Depth | None = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        name: str | None = None,
    ) -> Answer: ...

    @overload
    def localize(
        self,
        image: list[Any] | tuple[Any, ...],
        *,
        map: str | None = None,
        depth: Sequence[Depth | None] | None = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        name: Sequence[str] | None = None,
    ) -> list[Answer]: ...

    def tracker(
        self,
        map: str | None = None,
        *,
        camera: CameraLike | None = None,
        like: PathText | None = None,
        depth_scale: float | None = None,
    ) -> CameraTracker: ...

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
        progress: Callable[[str, int, int], None] | None = None,
    ) -> list[IngestSummary]: ...

    def trajectory(
        self,
        source: Source,
        *,
        every: int = 1,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        depth_scale: float | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> RecordedTrajectory: ...

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
    ) -> AlignReport: ...

    def undo_align(self, recording: str | None = None, *, map: str | None = None) -> PoseOperation: ...

    def refine(
        self,
        map: str | None = None,
        *,
        steps: Sequence[str] = (),
        force: bool = False,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> list[StepResult]: ...

    def delete(
        self,
        *,
        map: str | None = None,
        recording: str | None = None,
        keyframes: Iterable[int] | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> Deleted: ...
