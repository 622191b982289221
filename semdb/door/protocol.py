"""What a program can ask, wherever the database is: on this machine (`semdb.open`), or behind a service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self, TypeAlias, overload

if TYPE_CHECKING:
    from datetime import datetime

    from semdb.database.pose_records import PoseOperation
    from semdb.database.records import Deleted, MapInfo, RecordingStatus
    from semdb.door.found import Found
    from semdb.door.links import KeyframeLink
    from semdb.door.tracked import Tracked
    from semdb.door.values import Answer, Keyframe, Rows
    from semdb.ingestion.run import IngestSummary
    from semdb.localization.query_image import Depth, Image, PathText
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

    def loops(self, map: str | None = None, *, odometry: bool = False) -> list[KeyframeLink]: ...

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
