"""Working off the keyframes of a planned recording: what `semdb ingest` and every worker of a fleet do.

Keyframes are claimed in the database a few at a time, decoded, described and stored in stages that overlap, each
stored in one transaction that checks the claim. See `semdb.database.items` for what a claim is. Those that go through
the networks at once go through all stages together.
"""

from __future__ import annotations

import contextlib
import math
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from queue import SimpleQueue
from typing import Any

import cv2
import numpy as np

from semdb.database import items
from semdb.database.items import Claim
from semdb.database.records import KeyframeRecord, RowOptions
from semdb.database.store import Store
from semdb.errors import (
    DatabaseError,
    FrameError,
    LeaseLostError,
    ModelError,
    RecordingUnavailableError,
    SemdbError,
    UnstorableError,
    UsageError,
)
from semdb.events import event
from semdb.ingestion.pipeline import Stage, overlapped
from semdb.perception.describe import Describer, View
from semdb.perception.quality import image_quality
from semdb.recordings.base import FrameEntry, Recording, remarks_on
from semdb.recordings.kept_images import kept_images
from semdb.types import Description, Frame, InstanceMasks

STAGES = ("read", "detect", "encode", "features", "store")


@dataclass(slots=True)
class Item:
    """One keyframe on its way. In the end it is stored, has an `error`, or is `lost` to another worker."""

    claim: Claim
    entry: FrameEntry | None  # None: the recording has no such frame any more
    frame: Frame | None = None
    description: Description | None = None
    error: str | None = None
    lost: bool = False
    created: bool = False
    objects: int = 0
    keypoints: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    name: str = ""  # of the frame, once it is read
    remarks: tuple[str, ...] = ()  # what people should know of it

    @property
    def outcome(self) -> str:
        """``stored``, ``failed`` or ``lost``; for an item that is done."""
        return "lost" if self.lost else "failed" if self.error is not None else "stored"


def log_item(recording_id: int, item: Item) -> None:
    """Logs the event that a keyframe is done."""
    seconds: dict[str, Any] = {stage: round(value, 4) for stage, value in item.seconds.items()}
    event(item.outcome, recording=recording_id, frame=item.claim.frame_index, error=item.error, **seconds)


def work_off(
    recording: Recording,
    recording_id: int,
    store: Store,
    describers: Sequence[Describer],
    *,
    frames: Sequence[int] | None = None,
    stop: Callable[[], bool] = lambda: False,
    lease_s: int = items.LEASE_S,
    rows: RowOptions | None = None,
) -> Iterator[Item]:
    """Claims keyframes of `recording`, of `frames` where given, and stores them; yields each when it is done.

    Ends when none is left that nobody else works on, or soon after `stop` says so: what is under way is finished,
    what is not begun is given back. Each of `describers` works in a thread of its own, on as many keyframes at once as
    its `batch` says; fewer are not kept waiting. A frame that cannot be read or described is `failed`, and the rest
    goes on. Raises RecordingUnavailableError when the recording's folder is gone, NotFoundError when the recording is
    deleted, ProvenanceError, ModelError, DatabaseError.
    """
    worker = items.worker_name()
    batch = describers[0].batch
    batches = math.ceil((2 * len(describers) + 1) / batch)  # of one claim: all are busy, and others get theirs
    idle: SimpleQueue[Describer] = SimpleQueue()
    for describer in describers:
        idle.put(describer)
    stages = (
        Stage("read", lambda group: [_read(recording, item) for item in group]),
        Stage("describe", lambda group: _describe(idle, group), len(describers)),
        Stage("store", lambda group: [_store(store, recording_id, item, rows or RowOptions()) for item in group]),
    )
    claimed = _claims(recording, recording_id, store, worker, (batches, batch), frames, stop, lease_s)
    with _Renewal(store, recording_id, worker, lease_s), side_by_side():
        try:
            for group in overlapped(claimed, stages, window=max(batches, len(describers)) + 2):
                yield from group
        finally:
            items.release(store.engine, recording_id, worker)


def _claims(
    recording: Recording,
    recording_id: int,
    store: Store,
    worker: str,
    size: tuple[int, int],
    frames: Sequence[int] | None,
    stop: Callable[[], bool],
    lease_s: int,
) -> Iterator[list[Item]]:
    """Keyframes that this worker has claimed, in batches; `size` is how many of them a claim is for, and how large."""
    entries = {entry.index: entry for entry in recording.entries}
    items.release_dead(store.engine, recording_id)
    while not stop():
        claims = items.claim(
            store.engine, recording_id, worker, limit=size[0] * size[1], frames=frames, lease_s=lease_s
        )
        if not claims:
            return
        for group in _in_batches(claims, size[1]):
            if stop():
                return
            yield [Item(claim, entries.get(claim.frame_index)) for claim in group]


def _in_batches(claims: Sequence[Claim], batch: int) -> Iterator[list[Claim]]:
    """`claims` in their order, at most `batch` at once. One that was claimed before is alone: it may have been what
    ended the worker that had it, and would take its neighbours along each time.
    """
    group: list[Claim] = []
    for claim in claims:
        alone = claim.token > 1
        if group and (alone or len(group) == batch or group[-1].token > 1):
            yield group
            group = []
        group.append(claim)
    if group:
        yield group


_running, _running_lock, _before = 0, threading.Lock(), (0, 0.0)


@contextlib.contextmanager
def side_by_side() -> Iterator[None]:
    """While it lasts, threads of this process get in each other's way less; what was set before comes back.

    OpenCV uses one thread for a call instead of all cores, which are busy; and a thread that comes back from a network
    waits 0.5 ms for the interpreter, not 5. On two cores the speed-up over one thread went from 1.74 to 1.84.
    """
    global _running, _before  # noqa: PLW0603 (settings of the process)
    with _running_lock:
        if _running == 0:
            _before = (cv2.getNumThreads(), sys.getswitchinterval())
            cv2.setNumThreads(1)
            sys.setswitchinterval(0.0005)
        _running += 1
    try:
        yield
    finally:
        with _running_lock:
            _running -= 1
            if _running == 0:
                cv2.setNumThreads(_before[0])
                sys.setswitchinterval(_before[1])


class _Renewal:
    """A thread that renews the leases of a worker while it lives."""

    def __init__(self, store: Store, recording_id: int, worker: str, lease_s: int) -> None:
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(store, recording_id, worker, lease_s), daemon=True)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()

    def _run(self, store: Store, recording_id: int, worker: str, lease_s: int) -> None:
        while not self._end.wait(lease_s / 3):
            try:
                items.renew(store.engine, recording_id, worker, lease_s)
            except DatabaseError:
                continue  # where leases run out meanwhile, the writing transactions notice


def _read(recording: Recording, item: Item) -> Item:
    started = time.perf_counter()
    if item.entry is None:
        item.error = f"{recording.path}: has no usable frame {item.claim.frame_index} any more"
        return item
    try:
        item.frame = recording.read(item.entry)
        item.name, item.remarks = item.frame.name, tuple(remarks_on(item.frame))
    except FrameError as error:
        if not recording.path.exists():
            raise RecordingUnavailableError(
                f"{recording.path}: the recording is not there any more; when it is mounted again, run the same again"
            ) from error
        item.error = str(error)
    except (SemdbError, OSError, MemoryError):
        raise
    except Exception as error:
        _note_unexpected(item, item.entry.name, error)
    item.seconds["read"] = time.perf_counter() - started
    return item


def _note_unexpected(item: Item, name: str, error: Exception) -> None:
    """An error that no code here knows, on what is in one frame: others can be stored all the same."""
    item.error = f"{name}: {type(error).__name__}: {error}"
    event("unexpected", exc_info=error, frame=item.claim.frame_index, error=item.error)


def _describe(idle: SimpleQueue[Describer], group: list[Item]) -> list[Item]:
    """Those of `group` that could be read go through the networks at once; where that fails, one by one."""
    read = [(item, item.frame) for item in group if item.frame is not None]
    for item, frame in read:
        if frame.world_from_camera is None:
            item.frame, item.error = None, f"{frame.name} has no pose, so it cannot be a keyframe"
    read = [(item, frame) for item, frame in read if item.frame is not None]
    describer = idle.get()
    try:
        if len(read) > 1 and _describe_at_once(describer, read):
            return group
        for item, frame in read:
            _describe_alone(describer, item, frame)
    finally:
        idle.put(describer)
    return group


def _describe_at_once(describer: Describer, read: Sequence[tuple[Item, Frame]]) -> bool:
    """Whether all could be described: of what goes wrong with a batch nobody knows which frame it was."""
    views = [View(frame.image, frame.depth, frame.camera, frame.instances) for _, frame in read]
    try:
        found = describer.describe_batch(views)
    except Exception as error:
        event("one_by_one", frames=len(views), error=f"{type(error).__name__}: {error}")
        return False
    for (item, _), description in zip(read, found, strict=True):
        _take(item, description)
    return True


def _describe_alone(describer: Describer, item: Item, frame: Frame) -> None:
    """Raises what the networks raise when it is they that fail, and not this frame on which they do."""
    try:
        description = describer.describe(frame.image, frame.depth, frame.camera, frame.instances)
    except FrameError as error:
        item.error = f"{frame.name}: {error}"
    except ModelError as error:
        if not _works(describer, frame):
            raise
        item.error = f"{frame.name}: {error}"
    except (SemdbError, OSError, MemoryError):
        raise
    except Exception as error:
        if not _works(describer, frame):
            raise
        _note_unexpected(item, frame.name, error)
    else:
        _take(item, description)


def _works(describer: Describer, like: Frame) -> bool:
    """Whether `describer` can describe noise of the size of a frame."""
    noise = np.random.default_rng(0).integers(0, 256, like.image.shape, dtype=np.uint8)
    masks = like.instances
    nothing = None if masks is None else InstanceMasks(np.zeros_like(masks.labels), masks.categories)
    try:
        describer.describe(noise, None, like.camera, nothing)
    except Exception:
        return False
    return True


def _take(item: Item, description: Description) -> None:
    item.description = description
    for stage, milliseconds in description.timing_ms.items():
        item.seconds[stage] = milliseconds / 1000


def _store(store: Store, recording_id: int, item: Item, rows: RowOptions) -> Item:
    started = time.perf_counter()
    frame, description = item.frame, item.description
    item.frame = item.description = None  # so that what waits to be taken note of holds no images
    if frame is None or description is None or frame.world_from_camera is None:
        item.lost = not items.fail(store.engine, recording_id, item.claim, item.error or "")
        return item
    image, depth = kept_images(frame.image_bytes, frame.depth_bytes, rows.keep_images, frame.name)
    record = KeyframeRecord(
        frame_index=frame.index,
        timestamp_ns=frame.timestamp_ns,
        camera=frame.camera,
        world_from_camera=frame.world_from_camera,
        image_bytes=image,
        depth_bytes=depth,
        depth_scale=None if depth is None else frame.depth_scale,
        depth_registration="" if depth is None else frame.depth_registration,
        description=description,
        descriptor_dtype=rows.descriptor_dtype,
        quality=None if description.grey is None else image_quality(description.grey, description.stretch),
    )
    try:
        item.created = store.write_keyframe(recording_id, record, item.claim).created
    except LeaseLostError:
        item.lost = True
    except (UnstorableError, UsageError) as error:
        item.error = f"{frame.name}: {error}"
        item.lost = not items.fail(store.engine, recording_id, item.claim, item.error)
    item.objects, item.keypoints = len(description.detections), len(description.keypoints)
    item.seconds["store"] = time.perf_counter() - started
    return item
