"""A camera that moves through a map."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from semdb.api.localizing import Localizing, read_frame
from semdb.errors import FrameError, ProvenanceError, UsageError
from semdb.geometry import FARTHEST_POSE_M

if TYPE_CHECKING:
    from semdb.door.tracked import Tracked
    from semdb.localization.open_maps import OpenMap, OpenMaps
    from semdb.localization.query_image import Depth, Image, PathText, QueryImage, QueryReader
    from semdb.localization.views import View
    from semdb.recordings import ReadOptions, Recording
    from semdb.recordings.arrays import CameraLike
    from semdb.tracking.options import TrackerOptions
    from semdb.types import FloatArray, Localization

LOOKED_S = 1.0  # between two looks at what other processes did to the keyframes of the map
HEADS_S = 10.0  # and at whether it was refined or described anew, which takes longer
LAG = 60  # frames that a smoothed pose waits for


class MapTracker:
    """Tracks one camera in one map; made by `Database.tracker`. It is for one thread at a time."""

    def __init__(
        self, maps: OpenMaps, map_name: str | None, reader: QueryReader, options: TrackerOptions | None
    ) -> None:
        self._maps, self._reader, self._options = maps, reader, options
        self._begin(one_map(maps, map_name))
        self._looked_s, self._heads_s = -np.inf, -np.inf
        self._number = 0

    def _begin(self, entry: OpenMap) -> None:
        from semdb.tracking.tracker import Tracker

        self._entry, self._tracker = entry, Tracker(entry.localizer.cache, self._options)

    @property
    def map(self) -> str:
        """The name of the map."""
        return self._entry.head.name

    def update(
        self,
        image: Image,
        *,
        time_s: float | None = None,
        depth: Depth | None = None,
        odometry: FloatArray | None = None,
        name: str | None = None,
    ) -> Tracked:
        """Where the camera is now. `image` and `depth` are as of `Database.localize`.

        `time_s` is the time of the image in seconds, of any clock that only goes forwards; a `Frame` brings its own,
        and without both it is this computer's. `odometry` ``[4, 4]`` is where the robot's odometry has the camera
        (``odom_from_camera``) at that time. Networks run only where the camera is looked for in the whole map.
        Raises FrameError for an image that cannot be used, UsageError for a time that is not after the last one.
        """
        query = self._reader.read(image, depth, name, self._number)
        return self.update_query(query, time_s, odometry)

    def update_query(self, query: QueryImage, time_s: float | None, odometry: FloatArray | None) -> Tracked:
        """As `update`, of an image that is read."""
        from semdb.door.tracked import Tracked
        from semdb.door.values import frozen

        started = time.perf_counter()
        if time_s is None:
            time_s = time.monotonic() if query.timestamp_ns is None else query.timestamp_ns / 1e9
        self._look()
        entry = self._entry
        view = view_of(entry, query)

        def relocalize() -> Localization:
            from semdb.localization.unmasked import describe_query, lacks_masks, said_of, with_reason

            localized = entry.localizer.localize(describe_query(entry.describer, query))
            if not lacks_masks(entry.describer, query):
                return localized
            self._reader.tell(said_of(self.map))
            return with_reason(localized)

        try:
            found = self._tracker.update(view, time_s, relocalize, _checked(odometry))
        except ValueError as error:
            raise UsageError(f"{query.name}: {error}") from error
        self._number += 1
        return Tracked(
            image=query.name,
            time_s=float(time_s),
            state=found.state,
            source=found.source,
            map=self.map,
            world_from_camera=None if found.world_from_camera is None else frozen(found.world_from_camera),
            covariance=None if found.covariance is None else frozen(found.covariance),
            inliers=found.inliers,
            reason=found.reason,
            latency_ms=(time.perf_counter() - started) * 1000,
            confidence=found.confidence,
            map_from_odom=found.map_from_odom,
            frame_index=query.frame_index,
            timestamp_ns=query.timestamp_ns,
        )

    def _look(self) -> None:
        """Takes over what other processes did to the map."""
        now = time.monotonic()
        if now - self._looked_s < LOOKED_S:
            return
        self._looked_s = now
        if now - self._heads_s >= HEADS_S:
            self._take_over(now)
        try:
            keyframes = self._entry.localizer.refresh()
        except ProvenanceError:  # described anew by another encoder: what is open goes on with the old vectors
            keyframes = 0
        if not keyframes:  # or deleted, and another one may have its name
            self._take_over(now)
            self._entry.localizer.refresh()

    def _take_over(self, now: float) -> None:
        """The map as it is now. Poses in one that is not there any more say nothing of another one of that name."""
        self._heads_s = now
        entry = one_map(self._maps, self.map)
        if entry.head.id != self._entry.head.id:
            self._begin(entry)
        elif entry is not self._entry:
            self._entry = entry
            self._tracker.keyframes = entry.localizer.cache


class TrackingCameras(Localizing):
    """Says where a camera is, image after image."""

    def tracker(
        self,
        map: str | None = None,
        *,
        camera: CameraLike | None = None,
        like: PathText | None = None,
        depth_scale: float | None = None,
        options: TrackerOptions | None = None,
    ) -> MapTracker:
        """A tracker of one camera in a map; `camera`, `like` and `depth_scale` are as of `localize`.

        `map` may be left out where there is only one. Raises NotFoundError for a map that is not there or empty,
        UsageError where there are several, ProvenanceError, ModelError, DatabaseError.
        """
        maps = self._here.maps()
        return MapTracker(maps, map, self._reader(maps, map, camera, like, depth_scale), options)

    def track_recording(
        self,
        recording: PathText | Recording,
        *,
        map: str | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        like: PathText | None = None,
        every: int = 1,
        query_depth: bool = False,
        odometry: Callable[[int], FloatArray | None] | None = None,
        smooth: bool = False,
        options: TrackerOptions | None = None,
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Tracked]:
        """Tracks the camera through the frames of a recording, or `every` so many of them, in their order.

        `odometry` is asked for ``odom_from_camera`` ``[4, 4]`` at a time in nanoseconds. With `smooth` each pose is
        weighed against 60 frames after it too. The other arguments, and what is raised, are as of `localize_recording`
        and `tracker`.
        """
        from semdb.trajectory.recording import ASSUMED_RATE_HZ, times_of

        if every < 1:
            raise UsageError(f"every={every}: one frame in how many? From 1 on")
        opened = self.open_recording(recording, map=map, camera=camera, reading=reading, like=like)
        maps = self._here.maps()
        tracker = MapTracker(maps, map, self._reader(maps, map, None, None, None), options)
        entries = opened.entries[::every]
        times_s, timed = times_of(entries)
        if not timed:
            self._say(f"{opened.name}: frames have no times that go on; {ASSUMED_RATE_HZ:g} a second are assumed")

        def answers() -> Iterator[Tracked]:
            for entry, time_s in zip(entries, times_s, strict=True):
                try:
                    query = read_frame(opened, entry, query_depth, tracker._reader)
                except FrameError as error:
                    if unreadable is None:
                        raise
                    unreadable(error)
                    continue
                known = None if odometry is None or entry.timestamp_ns is None else odometry(entry.timestamp_ns)
                yield tracker.update_query(query, float(time_s), known)

        yield from smooth_answers(answers(), tracker) if smooth else answers()

    def _reader(
        self,
        maps: OpenMaps,
        map: str | None,
        camera: CameraLike | None,
        like: PathText | None,
        depth_scale: float | None,
    ) -> QueryReader:
        from semdb.localization.query_image import QueryReader
        from semdb.recordings.arrays import as_camera

        entries = [one_map(maps, map)]
        return QueryReader(
            camera=None if camera is None else as_camera(camera),
            like=None if like is None else self._like(entries, str(like)),
            known=lambda: maps.cameras(entries),
            used=lambda: maps.used_cameras(entries),
            depth_scale=depth_scale,
            on_disk=self._here.on_disk(),
            say=self._say,
        )


def smooth_answers(answers: Iterator[Tracked], tracker: MapTracker) -> Iterator[Tracked]:
    """The answers, each when `LAG` more are there, weighed against them."""
    from semdb.tracking.smoothing import FixedLag

    lag: FixedLag[Tracked] = FixedLag(LAG)

    def changed(item: Tracked, pose: FloatArray | None, covariance: FloatArray | None) -> Tracked:
        if item.world_from_camera is None or pose is None:
            return item
        return replace(item, world_from_camera=pose, covariance=covariance, smoothed=True)

    for answer in answers:
        yield from (changed(*found) for found in lag.push(answer, tracker._tracker.passage))
    yield from (changed(*found) for found in lag.flush())


def one_map(maps: OpenMaps, name: str | None) -> OpenMap:
    """The map of that name, or the only one. Raises UsageError where there are several."""
    found = maps.asked(name, "index")
    if len(found) > 1:
        names = ", ".join(sorted(entry.head.name for entry in found)[:10])
        raise UsageError(f"a camera is tracked in one map, and there are {names}: say which (map=, --map)")
    return found[0]


def view_of(entry: OpenMap, query: QueryImage) -> View:
    """What tracking sees of an image: local features alone, with 3D points where it has depth."""
    import cv2

    from semdb.localization.views import make_view
    from semdb.perception.lifting import lift
    from semdb.perception.quality import with_contrast
    from semdb.types import Keypoints

    grey, _ = with_contrast(np.asarray(cv2.cvtColor(query.image, cv2.COLOR_RGB2GRAY), np.uint8))
    features = entry.describer.features.extract(grey)
    points = lift(query.camera, query.depth, features.xy)
    keypoints = Keypoints(features, np.full(len(features), -1, np.int32), points)
    return make_view(query.camera, keypoints, (), entry.localizer.cache.numbers, grey=grey)


def odometry_file(path: Path) -> Callable[[int], FloatArray | None]:
    """Where a robot's odometry has the camera at a time in nanoseconds, from a file in TUM's format.

    Raises RecordingError for a file that cannot be read.
    """
    from semdb.recordings.association import pose_at, read_trajectory

    trajectory, _ = read_trajectory(path)
    return lambda time_ns: pose_at(trajectory, time_ns)[0]


def _checked(odometry: FloatArray | None) -> FloatArray | None:
    if odometry is None:
        return None
    pose = np.asarray(odometry, np.float64)
    good = pose.shape == (4, 4) and bool((np.abs(pose) <= FARTHEST_POSE_M).all())
    if good:
        turn = pose[:3, :3]
        rigid = np.abs(turn.T @ turn - np.eye(3)).max() < 1e-3 and np.linalg.det(turn) > 0
        good = bool(rigid and np.array_equal(pose[3], [0, 0, 0, 1]))
    if not good:
        raise UsageError("odometry is a rigid pose [4, 4], odom_from_camera in metres")
    return pose
