"""Images to poses, by a service."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

from semdb.client.surveying import Surveying
from semdb.client.transport import segment
from semdb.door.values import Answer
from semdb.errors import FrameError, UsageError
from semdb.names import storable

if TYPE_CHECKING:
    from semdb.client.images import ImageReader, Sent
    from semdb.localization.query_image import Depth, Image, PathText
    from semdb.recordings.arrays import CameraLike
    from semdb.recordings.base import FrameEntry, Recording
    from semdb.recordings.options import ReadOptions
    from semdb.types import Camera


class Localizing(Surveying):
    """Says where images were taken: they are read here, and sent."""

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
        accept: tuple[float, float] | None = None,
        log: bool = True,
        masks: bool = True,
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
        accept: tuple[float, float] | None = None,
        log: bool = True,
        masks: bool = True,
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
        name: Any = None,
        accept: tuple[float, float] | None = None,
        log: bool = True,
        masks: bool = True,
    ) -> Answer | list[Answer]:
        """Where an image was taken; a list of images gives a list of answers. See `semdb.api.Database.localize`.

        Files are sent as they are, arrays as PNG, depth of floats exactly where a scale of 16 bits holds it. `masks`
        False leaves out the pixels of the objects. An answer has no picture. Raises FrameError, NotFoundError,
        ProvenanceError, UsageError, ModelError, DatabaseError.
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
            names=None if names is None else list(names),
            accept=accept,
            log=log,
            masks=masks,
        )
        return list(answers) if many else next(answers)

    def localize_each(
        self,
        images: Sequence[Image],
        *,
        map: str | None = None,
        depth: Sequence[Depth | None] | None = None,
        camera: CameraLike | None = None,
        depth_scale: float | None = None,
        like: PathText | None = None,
        names: Sequence[str | None] | None = None,
        accept: tuple[float, float] | None = None,
        log: bool = True,
        masks: bool = True,
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Answer]:
        """As `localize`, the answers one by one as they are there.

        An image that cannot be read is told to `unreadable`, where that is given, and the others go on.
        """
        if depth and len(depth) != len(images):
            raise UsageError(f"{len(depth)} depth images for {len(images)} images: give --depth once per image")
        if names is not None and len(names) != len(images):
            raise UsageError(f"{len(names)} names for {len(images)} images: give one each")
        reader = self._reader(map, camera, like, depth_scale, images)

        def read(number: int) -> Sent:
            own, name = depth[number] if depth else None, None if names is None else names[number]
            return reader.read(images[number], own, name, number if len(images) > 1 else None)

        items = (partial(read, number) for number in range(len(images)))
        like_there = str(like) if reader.like_there is not None else None
        return self._answers(items, reader.tell, map, like_there, accept, log, masks, unreadable)

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
        accept: tuple[float, float] | None = None,
        log: bool = True,
        masks: bool = True,
        unreadable: Callable[[FrameError], None] | None = None,
    ) -> Iterator[Answer]:
        """Where the frames of a recording that is here were taken, one by one, or `every` so many of them.

        See `semdb.api.Database.localize_recording`. Raises RecordingError, and what `localize` raises.
        """
        opened = self.open_recording(recording, map=map, camera=camera, reading=reading, like=like)
        if every < 1:
            raise UsageError(f"every={every}: one frame in how many? From 1 on")
        reader = self._reader(map, None, None, None, ())
        items = (partial(read_frame, opened, entry, query_depth, reader) for entry in opened.entries[::every])
        return self._answers(items, reader.tell, map, None, accept, log, masks, unreadable)

    def open_recording(
        self,
        recording: PathText | Recording,
        *,
        map: str | None = None,
        camera: CameraLike | None = None,
        reading: ReadOptions | None = None,
        like: PathText | None = None,
    ) -> Recording:
        """The recording of a folder or file of this machine with the camera that `localize_recording` takes."""
        from semdb.recordings import open_recording
        from semdb.recordings.arrays import as_camera
        from semdb.recordings.base import Recording as Opened
        from semdb.recordings.dropped import lines_of_opening

        if isinstance(recording, Opened):
            return recording
        chosen = None if camera is None else as_camera(camera)
        if chosen is None and like is not None:
            reader = self._reader(map, None, like, None, ())
            chosen = reader.like.camera if reader.like is not None else self._camera_there(str(like), map)
        opened = open_recording(Path(recording), chosen, reading)
        for line in lines_of_opening(opened):
            self._say(line)
        return opened

    def _reader(
        self,
        map: str | None,
        camera: CameraLike | None,
        like: PathText | None,
        depth_scale: float | None,
        images: Sequence[Any],
    ) -> ImageReader:
        from semdb.client.images import ImageReader
        from semdb.localization.on_disk import RecordingsOnDisk
        from semdb.recordings.arrays import as_camera

        chosen = None if camera is None else as_camera(camera)
        here, there = None, None
        on_disk = RecordingsOnDisk()
        if like is not None:
            known = sorted({one.name for one in self.recordings(map)})
            if storable(str(like)) in known:
                there = partial(self._camera_there, str(like), map)
            elif Path(like).exists():
                here = on_disk.camera_like(Path(like))
            else:
                raise UsageError(
                    f"like {like}: there is neither a recording of that name in the database nor such a folder; "
                    f"recordings: {', '.join(known[:10])}{', ...' if len(known) > 10 else ''}"
                )
        paths = [Path(image) for image in images if isinstance(image, str | PathLike)]
        return ImageReader(self._say, on_disk, chosen, here, there, depth_scale, paths)

    def _camera_there(self, recording: str, map: str | None) -> Camera:
        """The camera of a recording that the service has."""
        found = self.keyframes(self.recording(recording, map).map, recording, limit=1)
        if not found:
            raise UsageError(f"like {recording}: it has no keyframe, so its camera is not known: give camera=")
        return found[0].camera

    def _answers(
        self,
        items: Iterable[Callable[[], Sent]],
        tell: Callable[[str], None],
        map: str | None,
        like: str | None,
        accept: tuple[float, float] | None,
        log: bool,
        masks: bool,
        unreadable: Callable[[FrameError], None] | None,
    ) -> Iterator[Answer]:
        """Reads the items one after the other and asks."""
        for read in items:
            try:
                sent = read()
                answer, notes = self._ask(sent, map, like, accept, log, masks)
            except FrameError as error:
                if unreadable is None:
                    raise
                unreadable(error)
                continue
            for line in notes:
                tell(line)
            yield answer

    def _ask(
        self,
        sent: Sent,
        map: str | None,
        like: str | None,
        accept: tuple[float, float] | None,
        log: bool,
        masks: bool,
    ) -> tuple[Answer, Sequence[str]]:
        from semdb.client.values import answer_of

        fields = sent.fields() | {"masks": str(masks).lower(), "log": str(log).lower()}
        if like is not None and sent.instances is None:
            fields["like"] = storable(like)
        if accept is not None:
            fields |= {"accept_m": repr(float(accept[0])), "accept_deg": repr(float(accept[1]))}
        path = "/v1/localize" if map is None else f"/v1/maps/{segment(map)}/localize"
        # the worst that asking twice does is a second line in the log of queries
        found = self._transport.json("POST", path, again=True, data=fields, files=sent.files())
        return answer_of(found, sent.name), found["notes"]


def read_frame(recording: Recording, entry: FrameEntry, with_depth: bool, reader: ImageReader) -> Sent:
    """One frame of a recording. Raises FrameError that names the file."""
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
        depth_scale=recording.depth_scale,
    )
    return reader.read(frame, name=recording.name_of(entry))
