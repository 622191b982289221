"""Images to poses."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from semdb.api.answers import answer_of
from semdb.api.base import Base
from semdb.database.store import Store
from semdb.door.values import Answer
from semdb.errors import DatabaseError, FrameError, NotFoundError, UsageError

if TYPE_CHECKING:  # the rooms behind are entered when something is asked of them: they take a second to import
    from semdb.localization.on_disk import LikeCamera
    from semdb.localization.open_maps import OpenMap
    from semdb.localization.query_image import Depth, Image, PathText, QueryImage, QueryReader
    from semdb.recordings import FrameEntry, ReadOptions, Recording
    from semdb.recordings.arrays import CameraLike
    from semdb.types import Localization


class Localizing(Base):
    """Says where images were taken."""

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
        coarse: str = "index",
        accept: tuple[float, float] | None = None,
        name: str | None = None,
        log: bool = True,
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
        coarse: str = "index",
        accept: tuple[float, float] | None = None,
        name: Sequence[str] | None = None,
        log: bool = True,
    ) -> list[Answer]: ...

    def localize(
        self,
        image: Image | list[Any] | tuple[Any, ...],
        *,
        map: str | None = None,
        depth: Any = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        coarse: str = "index",
        accept: tuple[float, float] | None = None,
        name: Any = None,
        log: bool = True,
    ) -> Answer | list[Answer]:
        """Where an image was taken; a list of images gives a list of answers.

        An image is an RGB (not BGR) or grey array uint8 ``[H, W, 3]``, ``[H, W]``, the path of a file, the bytes of
        one, or a `Frame`. `depth` is of its size and registered to it: an array in metres, or of integers with
        `depth_scale` units per metre, a path, or bytes; of several images, one each. `camera` is ``(fx, fy, cx, cy[,
        k1, k2, p1, p2[, k3]])`` in pixels, a `Camera` or a matrix ``[3, 3]``; `like` the name or folder of a recording
        whose camera took the image; without both it is the one camera of the map's keyframes. `map` None asks every
        map. `coarse` is ``index`` (from memory) or ``sql``; both answer alike. `name` is what an array is called in the
        answer and in the log of queries, which `log` False leaves out. Poses that differ by no more than `accept`
        (metres, degrees) are one for the caller: an answer is ambiguous only if others than these fit as well.

        An image that cannot be localized is an answer, ``failed``. Raises FrameError for an image, depth or camera that
        cannot be used, NotFoundError for a map that is not there or empty, ProvenanceError for other models than the
        map's, UsageError, ModelError, DatabaseError.
        """
        import numpy as np

        many = isinstance(image, list | tuple) or (isinstance(image, np.ndarray) and image.ndim == 4)
        images: list[Any] = list(image) if many else [image]  # type: ignore[arg-type]
        depths, names = (depth, name) if many else ([depth], [name])
        answers = self.localize_each(
            images,
            map=map,
            depth=None if depths is None else list(depths),
            camera=camera,
            depth_scale=depth_scale,
            like=like,
            coarse=coarse,
            accept=accept,
            names=None if names is None else list(names),
            log=log,
        )
        return list(answers) if many else next(answers)

    def prepare(self, map: str | None = None) -> None:
        """Loads the networks and the index that `localize` needs for a map, or all, unless they are there.

        Raises what `localize` raises.
        """
        self._here.maps().asked(map, "index")

    def localize_each(
        self,
        images: Sequence[Image],
        *,
        map: str | None = None,
        depth: Sequence[Depth | None] | None = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        coarse: str = "index",
        accept: tuple[float, float] | None = None,
        names: Sequence[str | None] | None = None,
        log: bool = True,
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Answer]:
        """As `localize`, the answers one by one as they are there.

        An image that cannot be read is told to `unreadable`, where that is given, and the others go on.
        """
        if depth and len(depth) != len(images):
            raise UsageError(f"{len(depth)} depth images for {len(images)} images: give --depth once per image")
        if names is not None and len(names) != len(images):
            raise UsageError(f"{len(names)} names for {len(images)} images: give one each")

        def read(number: int, reader: QueryReader) -> QueryImage:
            own, name = depth[number] if depth else None, None if names is None else names[number]
            return reader.read(images[number], own, name, number if len(images) > 1 else None)

        items = (partial(read, number) for number in range(len(images)))
        return self._answers(
            items,
            map,
            camera,
            like,
            coarse,
            accept=accept,
            depth_scale=depth_scale,
            paths=[Path(image) for image in images if isinstance(image, str | PathLike)],
            log=log,
            unreadable=unreadable,
        )

    def localize_recording(
        self,
        recording: PathText | Recording,
        *,
        map: str | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        like: PathText | None = None,
        every: int = 1,
        query_depth: bool = False,
        coarse: str = "index",
        accept: tuple[float, float] | None = None,
        log: bool = True,
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Answer]:
        """Where the frames of a recording were taken, one by one, or `every` so many of them.

        Poses that it may have are for pictures only; with `query_depth` its depth takes part. The camera is `camera`,
        else that of `like`, else the recording's own; `reading` says what its files do not. A frame that cannot be
        decoded is told to `unreadable`, where that is given, and the others go on. Raises RecordingError, and what
        `localize` raises.
        """
        opened = self.open_recording(recording, map=map, camera=camera, reading=reading, like=like)
        if every < 1:
            raise UsageError(f"every={every}: one frame in how many? From 1 on")
        items = (partial(read_frame, opened, entry, query_depth) for entry in opened.entries[::every])
        return self._answers(items, map, None, None, coarse, accept=accept, log=log, unreadable=unreadable)

    def open_recording(
        self,
        recording: PathText | Recording,
        *,
        map: str | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        like: PathText | None = None,
    ) -> Recording:
        """The recording of a folder or file with the camera that `localize_recording` takes, nothing decoded yet.

        What had to be assumed, and how many frames cannot be used, is said. Raises RecordingError, UsageError.
        """
        from semdb.recordings import open_recording
        from semdb.recordings.arrays import as_camera
        from semdb.recordings.base import Recording as Opened
        from semdb.recordings.dropped import lines_of_opening

        if isinstance(recording, Opened):
            return recording
        chosen = None if camera is None else as_camera(camera)
        if chosen is None and like is not None:
            chosen = self._like(self._here.maps().asked(map, "sql"), str(like)).camera
        opened = open_recording(Path(recording), chosen, reading)
        for line in lines_of_opening(opened):
            self._say(line)
        return opened

    def _answers(
        self,
        items: Iterable[Callable[[QueryReader], QueryImage]],
        map: str | None,
        camera: CameraLike | None,
        like: PathText | None,
        coarse: str,
        *,
        accept: tuple[float, float] | None = None,
        depth_scale: float | None = None,
        paths: Sequence[Path] = (),
        log: bool,
        unreadable: Callable[[FrameError], None] | None,
    ) -> Iterator[Answer]:
        """Reads the items one after the other and asks the maps as they are then."""
        from semdb.localization.acceptance import as_tolerance
        from semdb.localization.open_maps import ask
        from semdb.localization.query_image import QueryReader
        from semdb.localization.unmasked import said_of
        from semdb.recordings.arrays import as_camera

        tolerance = None if accept is None else as_tolerance(accept)
        store, open_maps = self._store(), self._here.maps()
        maps = open_maps.asked(map, coarse)
        reader = QueryReader(
            camera=None if camera is None else as_camera(camera),
            like=None if like is None else self._like(maps, str(like)),
            known=lambda: open_maps.cameras(maps),
            used=lambda: open_maps.used_cameras(maps),
            depth_scale=depth_scale,
            on_disk=self._here.on_disk(),
            paths=paths,
            say=self._say,
        )
        for number, read in enumerate(items):
            started = time.perf_counter()
            try:
                query = read(reader)
            except FrameError as error:
                if unreadable is None:
                    raise
                unreadable(error)
                continue
            decode_ms = (time.perf_counter() - started) * 1000
            maps = open_maps.asked(map, coarse) if number else maps  # as they are now
            found = ask(maps, query, lambda entry: open_maps.cameras([entry]), self._say, tolerance)
            if found.unmasked:
                reader.tell(said_of(found.localization.map_name))
            timing = {"decode": decode_ms, **found.description.timing_ms, **found.localization.timing_ms}
            timing["total"] = (time.perf_counter() - started) * 1000
            found = replace(found, localization=replace(found.localization, timing_ms=timing))
            if log:
                self._log(store, maps, query.name, found.localization)
            yield answer_of(found, self._store)

    def _like(self, maps: Sequence[OpenMap], name: str) -> LikeCamera:
        """The camera of a recording that the database knows by name, or of one on disk."""
        from semdb.localization.on_disk import LikeCamera

        store = self._store()
        for entry in maps:
            try:
                camera, depth_scale = store.recording_camera(store.find_recording(entry.head.id, name))
            except NotFoundError:
                continue
            return LikeCamera(camera, depth_scale, f"recording {name!r}")
        if Path(name).exists():
            return self._here.on_disk().camera_like(Path(name))
        known = sorted({recording.name for entry in maps for recording in store.status(entry.head.id)})
        raise UsageError(
            f"like {name}: there is neither a recording of that name in the database nor such a folder; "
            f"recordings: {', '.join(known[:10])}{', ...' if len(known) > 10 else ''}"
        )

    def _log(self, store: Store, maps: Sequence[OpenMap], image: str, localization: Localization) -> None:
        """An answer is given also where it cannot be logged, as with an account that may only read."""
        map_id = next(entry.head.id for entry in maps if entry.head.name == localization.map_name)
        try:
            store.log_query(map_id, image, localization)
        except (DatabaseError, UnicodeError) as error:
            self._say(f"the answer for {image} is not in the log of queries: {error}")


def read_frame(recording: Recording, entry: FrameEntry, with_depth: bool, reader: QueryReader) -> QueryImage:
    """One frame of a recording as a query. Raises FrameError that names the file."""
    from semdb.types import Frame

    frame = Frame(
        index=entry.index,
        name=entry.name,
        timestamp_ns=entry.timestamp_ns,
        image=recording.read_image(entry),
        depth=recording.read_depth(entry) if with_depth else None,
        camera=recording.camera_of(entry),
        world_from_camera=entry.world_from_camera,
        instances=recording.read_instances(entry),
    )
    return reader.read(frame, name=recording.name_of(entry))
