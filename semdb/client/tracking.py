"""A camera that moves through a map of a service."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from semdb.client.images import camera_text
from semdb.client.localizing import Localizing, read_frame
from semdb.client.transport import segment
from semdb.errors import FrameError, NotFoundError, SemdbError, UsageError
from semdb.names import storable

if TYPE_CHECKING:
    from semdb.client.images import ImageReader, Sent
    from semdb.client.transport import Transport
    from semdb.door.tracked import Tracked
    from semdb.localization.query_image import Depth, Image, PathText
    from semdb.recordings.arrays import CameraLike
    from semdb.recordings.base import Recording
    from semdb.recordings.options import ReadOptions
    from semdb.types import FloatArray


class RemoteTracker:
    """Tracks one camera in one map; made by `RemoteDatabase.tracker`. It is for one thread at a time.

    A service lets a camera go of which nothing comes for a while, and looks for it anew when it does.
    """

    def __init__(self, transport: Transport, map_name: str, reader: ImageReader, like: str | None) -> None:
        self._transport, self._map, self._reader = transport, map_name, reader
        common: dict[str, Any] = {}
        self._camera = None if reader.camera is None else camera_text(reader.camera)
        if self._camera is not None:
            common["camera"] = self._camera
        if like is not None:
            common["like"] = storable(like)
        self._common = common
        self._address = self._opened()
        self._number = 0

    def _opened(self) -> str:
        """The address for frames of a new session."""
        # the worst that asking twice does is a second camera, which is let go by itself
        path = f"/v1/maps/{segment(self._map)}/sessions"
        return str(self._transport.json("POST", path, again=True, json=self._common)["frames"])

    @property
    def map(self) -> str:
        """The name of the map."""
        return self._map

    def update(
        self,
        image: Image,
        *,
        time_s: float | None = None,
        depth: Depth | None = None,
        odometry: FloatArray | None = None,
        name: str | None = None,
    ) -> Tracked:
        """Where the camera is now; see `semdb.api.tracking.MapTracker.update`.

        Raises FrameError for an image that cannot be used, UsageError for a time that is not after the last one.
        """
        return self.update_sent(self._reader.read(image, depth, name, self._number), time_s, odometry)

    def update_sent(self, sent: Sent, time_s: float | None, odometry: FloatArray | None) -> Tracked:
        """As `update`, of an image that is read."""
        from semdb.client.values import tracked_of

        if time_s is None:
            time_s = time.monotonic() if sent.timestamp_ns is None else sent.timestamp_ns / 1e9
        fields = sent.fields() | {"time_s": repr(float(time_s))}
        if fields.get("camera") == self._camera:
            fields.pop("camera", None)
        if odometry is not None:
            pose = np.asarray(odometry, np.float64)
            if pose.shape != (4, 4):
                raise UsageError("odometry is a rigid pose [4, 4], odom_from_camera in metres")
            fields["odometry"] = ",".join(repr(float(number)) for number in pose.ravel())
        found = self._ask(fields, sent.files())
        self._number += 1
        for line in found["notes"]:
            self._reader.tell(line)
        return tracked_of(found, sent.name)

    def _ask(self, fields: dict[str, str], files: dict[str, Any]) -> Any:
        # a frame that comes a second time gets the answer of the first
        try:
            return self._transport.json("POST", self._address, again=True, data=fields, files=files)
        except NotFoundError:  # its time is over, or the service began anew with another secret
            self._address = self._opened()
        return self._transport.json("POST", self._address, again=True, data=fields, files=files)

    def close(self) -> None:
        """Lets the camera go."""
        with contextlib.suppress(SemdbError):
            self._transport.ask("DELETE", self._address.removesuffix("/frames"), again=True)

    def __enter__(self) -> RemoteTracker:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class TrackingCameras(Localizing):
    """Says where a camera is, image after image."""

    def tracker(
        self,
        map: str | None = None,
        *,
        camera: CameraLike | None = None,
        like: PathText | None = None,
        depth_scale: float | None = None,
    ) -> RemoteTracker:
        """A tracker of one camera in a map; see `semdb.api.Database.tracker`. Close it when the camera is done.

        Raises NotFoundError, UsageError, ProvenanceError, ModelError, DatabaseError.
        """
        chosen = map if map is not None else self._only_map()
        reader = self._reader(chosen, camera, like, depth_scale, ())
        there = str(like) if reader.like_there is not None else None
        return RemoteTracker(self._transport, chosen, reader, there)

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
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Tracked]:
        """Tracks the camera through the frames of a recording that is here, or `every` so many of them, in their order.

        See `semdb.api.Database.track_recording`. Raises RecordingError, and what `tracker` raises.
        """
        from semdb.trajectory.recording import ASSUMED_RATE_HZ, times_of

        if every < 1:
            raise UsageError(f"every={every}: one frame in how many? From 1 on")
        opened = self.open_recording(recording, map=map, camera=camera, reading=reading, like=like)
        entries = opened.entries[::every]
        times_s, timed = times_of(entries)
        if not timed:
            self._say(f"{opened.name}: frames have no times that go on; {ASSUMED_RATE_HZ:g} a second are assumed")
        with self.tracker(map) as tracker:
            for entry, time_s in zip(entries, times_s, strict=True):
                try:
                    sent = read_frame(opened, entry, query_depth, tracker._reader)
                except FrameError as error:
                    if unreadable is None:
                        raise
                    unreadable(error)
                    continue
                known = None if odometry is None or entry.timestamp_ns is None else odometry(entry.timestamp_ns)
                yield tracker.update_sent(sent, float(time_s), known)

    def _only_map(self) -> str:
        names = sorted(one.name for one in self.maps())
        if not names:
            raise NotFoundError(f"{self.url}: there is no map yet: `semdb ingest` makes one")
        if len(names) > 1:
            listed = ", ".join(names[:10])
            raise UsageError(f"a camera is tracked in one map, and there are {listed}: say which (map=, --map)")
        return names[0]
