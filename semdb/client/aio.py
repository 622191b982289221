"""The same for asyncio: requests run in threads, so that the loop goes on."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Self, TypeVar

from semdb.client.writing import Writing

if TYPE_CHECKING:
    from semdb.client.tracking import RemoteTracker
    from semdb.database.jobs import Job
    from semdb.database.landmark_reading import StoredLandmark, StoredRelation
    from semdb.database.landmark_records import LandmarkVisit
    from semdb.database.query_log import LoggedQuery
    from semdb.database.records import Deleted, FailedItem, MapInfo, RecordingStatus, StoredImage
    from semdb.database.scene_reading import StoredSighting
    from semdb.door.changed import Changes
    from semdb.door.found import Found
    from semdb.door.links import KeyframeLink
    from semdb.door.tracked import Tracked
    from semdb.door.values import Answer, Keyframe, Rows
    from semdb.ingestion.run import IngestSummary
    from semdb.localization.coverage import Coverage
    from semdb.pictures.cloud import Cloud
    from semdb.recordings.base import Recording
    from semdb.types import ModelInfo

T = TypeVar("T")
MOST_AT_ONCE = 32
_END = object()


class AsyncTracker:
    """The methods of `RemoteTracker` as coroutines; for one task at a time."""

    def __init__(self, tracker: RemoteTracker, run: Callable[..., Awaitable[Any]]) -> None:
        self._tracker, self._run = tracker, run

    @property
    def map(self) -> str:
        """The name of the map."""
        return self._tracker.map

    async def update(self, image: Any, **options: Any) -> Tracked:
        """As `RemoteTracker.update`."""
        found: Tracked = await self._run(self._tracker.update, image, **options)
        return found

    async def close(self) -> None:
        """Lets the camera go."""
        await self._run(self._tracker.close)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()


class AsyncDatabase:
    """The methods of `RemoteDatabase` as coroutines, which take what those take; at most 32 run at once.

    A task that is cancelled does not wait any longer; what was asked goes on, and is not heard of. What a keyframe
    reads when it is looked at blocks: `load` reads it before.
    """

    def __init__(self, database: Writing) -> None:
        self.database = database
        self._pool = ThreadPoolExecutor(MOST_AT_ONCE, thread_name_prefix="semdb-client")

    async def _run(self, work: Callable[..., T], *arguments: Any, **options: Any) -> T:
        return await asyncio.get_running_loop().run_in_executor(self._pool, lambda: work(*arguments, **options))

    async def _each(self, begin: Callable[[], Iterator[T]]) -> AsyncIterator[T]:
        answers = await self._run(begin)
        while (answer := await self._run(next, answers, _END)) is not _END:
            yield answer

    @property
    def url(self) -> str:
        """The address of the service."""
        return self.database.url

    async def close(self) -> None:
        """Lets go of the connections."""
        await self._run(self.database.close)
        self._pool.shutdown(wait=False)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def check(self) -> None:
        """Asks for something now."""
        await self._run(self.database.check)

    async def maps(self) -> list[MapInfo]:
        """As `RemoteDatabase.maps`."""
        return await self._run(self.database.maps)

    async def map(self, name: str) -> MapInfo:
        """As `RemoteDatabase.map`."""
        return await self._run(self.database.map, name)

    async def models(self, map: str) -> tuple[ModelInfo, ...]:
        """As `RemoteDatabase.models`."""
        return await self._run(self.database.models, map)

    async def recordings(self, map: str | None = None) -> list[RecordingStatus]:
        """As `RemoteDatabase.recordings`."""
        return await self._run(self.database.recordings, map)

    async def recording(self, name: str, map: str | None = None) -> RecordingStatus:
        """As `RemoteDatabase.recording`."""
        return await self._run(self.database.recording, name, map)

    async def keyframe(self, keyframe_id: int) -> Keyframe:
        """As `RemoteDatabase.keyframe`."""
        return await self._run(self.database.keyframe, keyframe_id)

    async def keyframes(self, map: str | None = None, recording: str | None = None, **options: Any) -> list[Keyframe]:
        """As `RemoteDatabase.keyframes`."""
        return await self._run(self.database.keyframes, map, recording, **options)

    async def get(self, path: str, **parameters: Any) -> Any:
        """As `RemoteDatabase.get`."""
        return await self._run(self.database.get, path, **parameters)

    def pages(self, path: str, **parameters: Any) -> AsyncIterator[Any]:
        """As `RemoteDatabase.pages`, for ``async for``."""
        return self._each(lambda: self.database.pages(path, **parameters))

    async def load(self, keyframe: Keyframe, *what: str) -> Keyframe:
        """The keyframe, with its ``image``, ``depth``, ``objects``, ``keypoints``, or all, read and kept."""
        for name in what or ("image", "depth", "objects", "keypoints"):
            await self._run(getattr, keyframe, name)
        return keyframe

    async def loops(self, map: str | None = None, **options: Any) -> list[KeyframeLink]:
        """As `RemoteDatabase.loops`."""
        return await self._run(self.database.loops, map, **options)

    async def has_recording(self, name: str, map: str | None = None) -> bool:
        """As `RemoteDatabase.has_recording`."""
        return await self._run(self.database.has_recording, name, map)

    async def check_keyframes(self, ids: Iterable[int]) -> None:
        """As `RemoteDatabase.check_keyframes`."""
        await self._run(self.database.check_keyframes, ids)

    async def keyframe_files(self, keyframe_id: int) -> StoredImage:
        """As `RemoteDatabase.keyframe_files`."""
        return await self._run(self.database.keyframe_files, keyframe_id)

    async def landmarks(self, map: str, **options: Any) -> list[StoredLandmark]:
        """As `RemoteDatabase.landmarks`."""
        return await self._run(self.database.landmarks, map, **options)

    async def relations(self, map: str, **options: Any) -> list[StoredRelation]:
        """As `RemoteDatabase.relations`."""
        return await self._run(self.database.relations, map, **options)

    async def up(self, map: str) -> tuple[float, float, float] | None:
        """As `RemoteDatabase.up`."""
        return await self._run(self.database.up, map)

    async def coverage(self, map: str, position: Sequence[float] | None = None, *, radius_m: float = 2.0) -> Coverage:
        """As `RemoteDatabase.coverage`."""
        return await self._run(self.database.coverage, map, position, radius_m=radius_m)

    async def sightings(self, map: str, landmark: int) -> list[StoredSighting]:
        """As `RemoteDatabase.sightings`."""
        return await self._run(self.database.sightings, map, landmark)

    async def visits(self, map: str, landmark: int) -> list[LandmarkVisit]:
        """As `RemoteDatabase.visits`."""
        return await self._run(self.database.visits, map, landmark)

    async def seen_in(self, keyframe_id: int) -> list[StoredSighting]:
        """As `RemoteDatabase.seen_in`."""
        return await self._run(self.database.seen_in, keyframe_id)

    async def scene(self, map: str) -> dict[str, Any]:
        """As `RemoteDatabase.scene`."""
        return await self._run(self.database.scene, map)

    async def cloud(self, map: str, points: int = 100_000) -> Cloud:
        """As `RemoteDatabase.cloud`."""
        return await self._run(self.database.cloud, map, points)

    async def queries(self, map: str, **options: Any) -> list[LoggedQuery]:
        """As `RemoteDatabase.queries`."""
        return await self._run(self.database.queries, map, **options)

    async def query(self, query_id: int) -> tuple[str, LoggedQuery]:
        """As `RemoteDatabase.query`."""
        return await self._run(self.database.query, query_id)

    async def failures(self, recording: str, map: str) -> list[FailedItem]:
        """As `RemoteDatabase.failures`."""
        return await self._run(self.database.failures, recording, map)

    async def job(self, job_id: int) -> Job:
        """As `RemoteDatabase.job`."""
        return await self._run(self.database.job, job_id)

    async def jobs(self, map: str | None = None, **options: Any) -> list[Job]:
        """As `RemoteDatabase.jobs`."""
        return await self._run(self.database.jobs, map, **options)

    async def open_recording(self, recording: Any, **options: Any) -> Recording:
        """As `RemoteDatabase.open_recording`."""
        return await self._run(self.database.open_recording, recording, **options)

    async def find(self, what: str, **options: Any) -> Found:
        """As `RemoteDatabase.find`."""
        return await self._run(self.database.find, what, **options)

    async def changes(self, before: str, after: str, map: str | None = None) -> Changes:
        """As `RemoteDatabase.changes`."""
        return await self._run(self.database.changes, before, after, map)

    async def sql(self, statement: str) -> Rows:
        """As `RemoteDatabase.sql`: the rows are there."""
        return await self._run(self.database.sql, statement)

    async def tables(self) -> dict[str, tuple[str, ...]]:
        """As `RemoteDatabase.tables`."""
        return await self._run(self.database.tables)

    async def localize(self, image: Any, **options: Any) -> Any:
        """As `RemoteDatabase.localize`: an `Answer`, of a list of images a list of them."""
        return await self._run(self.database.localize, image, **options)

    def localize_each(self, images: Any, **options: Any) -> AsyncIterator[Answer]:
        """As `RemoteDatabase.localize_each`, for ``async for``."""
        return self._each(lambda: self.database.localize_each(images, **options))

    def localize_recording(self, recording: Any, **options: Any) -> AsyncIterator[Answer]:
        """As `RemoteDatabase.localize_recording`, for ``async for``."""
        return self._each(lambda: self.database.localize_recording(recording, **options))

    async def tracker(self, map: str | None = None, **options: Any) -> AsyncTracker:
        """As `RemoteDatabase.tracker`."""
        return AsyncTracker(await self._run(self.database.tracker, map, **options), self._run)

    def track_recording(self, recording: Any, **options: Any) -> AsyncIterator[Tracked]:
        """As `RemoteDatabase.track_recording`, for ``async for``."""
        return self._each(lambda: self.database.track_recording(recording, **options))

    async def ingest(self, source: Any, **options: Any) -> list[IngestSummary]:
        """As `RemoteDatabase.ingest`; `progress` is called in another thread."""
        return await self._run(self.database.ingest, source, **options)

    async def delete(
        self,
        *,
        map: str | None = None,
        recording: str | None = None,
        keyframes: Iterable[int] | None = None,
        **options: Any,
    ) -> Deleted:
        """As `RemoteDatabase.delete`."""
        return await self._run(self.database.delete, map=map, recording=recording, keyframes=keyframes, **options)
