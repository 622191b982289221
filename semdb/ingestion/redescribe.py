"""Keyframes of a map described anew by another encoder, or shown to it in another way: from images that are stored.

New vectors are written beside the old ones, which answer until all are there; then one transaction switches
(`semdb.database.encodings`). Cut off anywhere, another run goes on with what is left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

from semdb.database.encodings import (
    add_vectors,
    drop_vectors,
    encoder_of,
    iter_image_kinds,
    keyframes_without,
    switch_encoder,
)
from semdb.database.planning import stored_plan
from semdb.database.records import ImageKind, MapInfo
from semdb.database.store import Store
from semdb.errors import CodecError, DatabaseError, FrameError, NotFoundError, RecordingError, UsageError
from semdb.ingestion.pipeline import Stage, overlapped
from semdb.ingestion.plan import few
from semdb.ingestion.planned import open_planned
from semdb.perception.encoders import load_encoder
from semdb.perception.model_choice import spec_for_redescription
from semdb.perception.protocols import BatchEncoder, Encoder
from semdb.perception.quality import with_contrast
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.images import decode_color
from semdb.recordings.jpeg import JPEG_START, read_jpeg_header
from semdb.recordings.png import ImageFileError
from semdb.settings import Settings
from semdb.types import Float32Array, ImageArray, ModelInfo

CHUNK = 8  # keyframes that go through the stages together
GREY = (
    "only small grey images of its keyframes were kept (SEMDB_KEEP_IMAGES=none), so they have to be described from the "
    "recording; nothing was changed"
)
ROUNDS = 10  # that keyframes which others store meanwhile may keep it from its end
SHOWN = 5

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Redescribed:
    """What was, or would be, described anew: `keyframes` of the map, of which `described` now, and so many of them
    from `recordings`; the encoder before and after.
    """

    map_name: str
    keyframes: int
    described: int
    recordings: int
    before: ModelInfo
    after: ModelInfo

    @property
    def switched(self) -> bool:
        """Whether the map is asked by other vectors than before."""
        return self.before != self.after


@dataclass(slots=True)
class _Some:
    """Keyframes on their way: images, then vectors, of those that can be read."""

    kinds: list[ImageKind]
    images: dict[int, ImageArray]
    vectors: dict[int, Float32Array]


def redescribe_map(
    store: Store,
    info: MapInfo,
    settings: Settings,
    *,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> Redescribed:
    """Describes all keyframes of a map by the encoder that `settings` name, as a new map would be.

    Images come from the database; where only small grey ones were kept, from their recordings. Raises RecordingError
    where those are not there any more, before anything is written; UsageError for a map that holds no keyframe or is
    being ingested, or keyframes whose images cannot be read (the map stays as it is); ModelError, DatabaseError.
    """
    before = {model.role: model for model in store.map_models(info.id)}.get("encoder")
    if before is None or not info.keyframes:
        raise UsageError(f"the map {info.name!r} holds no keyframe, so there is nothing to describe")
    spec, own = spec_for_redescription(settings, before)
    encoder = load_encoder(spec, own)
    known = encoder_of(store.engine, encoder.info, make=not dry_run)
    left = keyframes_without(store.engine, info.id, known)
    sources = _Sources(store, settings, left, progress, info.name)
    done = Redescribed(info.name, info.keyframes, len(left), sources.from_recordings, before, encoder.info)
    if dry_run or known is None:
        return done
    engine, current = store.engine, store.encoder_id(info.id)
    drop_vectors(engine, info.id, [key for key in (known, current) if key is not None])
    total, brought, failed = 0, 0, dict[int, str]()
    for _ in range(ROUNDS):
        total += _describe(store, sources, encoder, (info.id, known), failed, progress, info.name)
        brought += sources.from_recordings
        if failed:
            raise UsageError(_failed_text(info.name, failed))
        if not switch_encoder(engine, info.id, known):
            drop_vectors(engine, info.id, [known], None if progress is None else partial(progress, "clearing old ones"))
            return Redescribed(info.name, info.keyframes, total, brought, before, encoder.info)
        sources = _Sources(store, settings, keyframes_without(engine, info.id, known), progress, info.name)
    raise DatabaseError(
        f"keyframes came into the map {info.name!r} all the time: run it again when nothing is ingested"
    )


def _failed_text(name: str, failed: dict[int, str]) -> str:
    some = "; ".join(list(failed.values())[:SHOWN]) + ("; ..." if len(failed) > SHOWN else "")
    return (
        f"{len(failed)} keyframes of the map {name!r} cannot be described, and it keeps its old vectors until all are: "
        f"{some}. Delete these keyframes (semdb delete keyframes {' '.join(map(str, list(failed)[:SHOWN]))}), and run "
        "this again"
    )


def _describe(
    store: Store,
    sources: _Sources,
    encoder: Encoder,
    target: tuple[int, int],
    failed: dict[int, str],
    progress: Progress | None,
    name: str,
) -> int:
    """Writes the vectors of all of `sources`, of a map by a model; `failed` is told of those that cannot be read.

    Returns how many were written.
    """
    stages = (
        Stage("read", lambda some: _read(sources, some, failed)),
        Stage("encode", lambda some: _encode(encoder, some)),
        Stage("store", lambda some: _store(store, target, some)),
    )
    groups = _groups(sources.kinds)
    done = written = 0
    for some in overlapped(groups, stages, window=4):
        done += len(some.kinds)
        written += len(some.vectors)
        if progress is not None:
            progress(f"describing {name}", done, len(sources.kinds))
    return written


def _groups(kinds: Sequence[ImageKind]) -> Iterator[_Some]:
    for start in range(0, len(kinds), CHUNK):
        yield _Some(list(kinds[start : start + CHUNK]), {}, {})


def _read(sources: _Sources, some: _Some, failed: dict[int, str]) -> _Some:
    for kind in some.kinds:
        try:
            some.images[kind.keyframe_id] = with_contrast(sources.image(kind))[0]
        except NotFoundError:
            continue  # it was deleted meanwhile
        except (CodecError, FrameError) as error:
            failed[kind.keyframe_id] = str(error)
    return some


def _encode(encoder: Encoder, some: _Some) -> _Some:
    keys, images = list(some.images), list(some.images.values())
    some.images = {}
    if isinstance(encoder, BatchEncoder) and encoder.best_batch > 1 and images:
        some.vectors = dict(zip(keys, encoder.encode_batch(images), strict=True))
    else:
        some.vectors = {key: encoder.encode(image) for key, image in zip(keys, images, strict=True)}
    return some


def _store(store: Store, target: tuple[int, int], some: _Some) -> _Some:
    if some.vectors:
        add_vectors(store.engine, *target, some.vectors)
    return some


class _Sources:
    """Where the image of each keyframe comes from."""

    def __init__(
        self, store: Store, settings: Settings, keyframe_ids: Sequence[int], progress: Progress | None, name: str
    ) -> None:
        """Raises RecordingError where a recording is needed and not there."""
        self._store = store
        self._settings = settings
        self._opened: dict[int, tuple[Recording, dict[int, FrameEntry]]] = {}
        self.kinds: list[ImageKind] = []  # without their heads
        self._grey: set[int] = set()
        frames: dict[int, list[int]] = {}
        for kind in iter_image_kinds(store.engine, keyframe_ids):
            self.kinds.append(replace(kind, head=b""))
            if _is_grey(kind):
                self._grey.add(kind.keyframe_id)
                frames.setdefault(kind.recording_id, []).append(kind.frame_index)
            if progress is not None:
                progress(f"looking at images of {name}", len(self.kinds), len(keyframe_ids))
        self.from_recordings = len(self._grey)
        for recording_id in sorted(frames):
            self._open(recording_id, frames[recording_id])

    def image(self, kind: ImageKind) -> ImageArray:
        """RGB ``[H, W, 3]``. Raises NotFoundError, CodecError, FrameError."""
        if kind.keyframe_id not in self._grey:
            rgb = self._store.load_image(kind.keyframe_id).rgb
            return decode_color(rgb, f"keyframe_images.rgb of keyframe {kind.keyframe_id}")
        recording, entries = self._opened[kind.recording_id]
        return recording.read_image(entries[kind.frame_index])

    def _open(self, recording_id: int, frames: Sequence[int]) -> None:
        plan = stored_plan(self._store.engine, recording_id)
        try:
            recording = open_planned(self._store, plan, self._settings, "mount it where it was")
        except RecordingError as error:
            raise RecordingError(f"{error}; {GREY}") from error
        entries = {entry.index: entry for entry in recording.entries}
        missing = [index for index in frames if index not in entries]
        if missing:
            raise RecordingError(f"{recording.path}: has no {few(missing)} any more; {GREY}")
        self._opened[recording_id] = (recording, entries)


def _is_grey(kind: ImageKind) -> bool:
    """Whether what is stored has no colours: a grey JPEG, as is kept in place of images."""
    if not kind.head.startswith(JPEG_START):
        return False
    try:
        return read_jpeg_header(kind.head)[3] == 1
    except ImageFileError:
        return False  # its header comes late, which that of a kept one does not, or it is damaged
