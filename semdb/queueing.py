"""Ingest by a fleet: plans go into the database, messages name keyframes of them, workers do what a message says.

The database holds the truth. A message may be lost, for `sweep` sends another, or arrive twice, for a keyframe is
claimed before it is worked on. Nothing here knows how messages travel: `send` is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

from semdb.database import items
from semdb.database.planning import StoredPlan, stored_plan
from semdb.database.requeue import requeue_failed
from semdb.database.store import Store, open_store
from semdb.errors import NotFoundError, RecordingUnavailableError, UsageError
from semdb.ingest import (
    IngestOptions,
    IngestSummary,
    Progress,
    fingerprint,
    make_describers,
    map_models_of,
    open_all,
    plan_ingest,
)
from semdb.item_work import Item, work_off
from semdb.model_choice import ModelSpecs, settings_of_map, specs_for_ingest
from semdb.perception.describe import Describer
from semdb.recordings import open_recordings
from semdb.recordings.base import Recording
from semdb.recordings.source import locate, parse_source
from semdb.settings import Settings

CHUNK = 16  # keyframes of one message
MESSAGE_WAIT_S = 900  # after this long a keyframe that was sent and not begun is sent again

Send = Callable[[int, str, Sequence[int]], None]  # recording id, source, frame indexes


def queue_recordings(
    paths: Sequence[str],
    settings: Settings,
    options: IngestOptions,
    send: Send,
    *,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> list[IngestSummary]:
    """Plans every recording under `paths` and sends its keyframes; nothing is described here.

    Raises as `ingest_recordings` does, and what `send` raises: then the plan is in the database and `sweep` sends it.
    """
    summaries = []
    with open_store(settings.database_url, create=True) as store:
        for recording in open_all(paths, settings, options):
            known = map_models_of(store, options.map_of(recording))
            specs = specs_for_ingest(settings, known, has_masks=recording.categories is not None)
            for note in (*recording.notes, *specs.notes):
                if say is not None:
                    say(f"{recording.name}: {note}")
            one = settings_of_map(settings, known).model_copy(update={"threads": 1})
            models = make_describers(specs, one)[0].models
            summary, _ = plan_ingest(recording, store, models, options, progress=progress)
            summary.notes = (*recording.notes, *specs.notes)
            requeue_failed(store.engine, summary.recording_id)
            sweep(store, send, recording_id=summary.recording_id)
            store.finish_recording(summary.recording_id)
            summaries.append(summary)
    return summaries


def sweep(store: Store, send: Send, *, recording_id: int | None = None, all_pending: bool = False) -> int:
    """Sends all keyframes that no living worker has and no message is known to name. Returns how many.

    With `all_pending` also those whose messages may still be under way: for a broker that lost its messages.
    """
    sent = 0
    for queued in items.lost(store.engine, recording_id, all_pending=all_pending):
        for chunk in chunks(queued.frame_indexes):
            items.mark_sent(store.engine, queued.recording_id, chunk, MESSAGE_WAIT_S)
            send(queued.recording_id, queued.source, chunk)
            sent += len(chunk)
    return sent


def chunks(indexes: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """`indexes` in parts of the size of a message."""
    for start in range(0, len(indexes), CHUNK):
        yield tuple(indexes[start : start + CHUNK])


@dataclass(slots=True)
class ChunkOutcome:
    """What became of the keyframes of one message. `left`: not done, for the worker was to stop."""

    stored: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    lost: int = 0
    left: tuple[int, ...] = ()
    complete: bool = False


class Workplace:
    """What a process keeps from one message to the next: networks, and the recording that was opened last."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._describers: dict[object, list[Describer]] = {}
        self._opened: tuple[tuple[int, str, str], Recording] | None = None

    def do(
        self,
        recording_id: int,
        source: str,
        frames: Sequence[int],
        *,
        stop: Callable[[], bool] = lambda: False,
        note: Callable[[Item], None] = lambda _item: None,
    ) -> ChunkOutcome:
        """Works off those of `frames` that nobody else has; `note` is told of each that is done.

        A recording that was deleted gives an empty outcome. Raises RecordingUnavailableError for one that cannot be
        seen here now, UsageError for one that is another here than where it was planned, DatabaseError, ModelError.
        """
        outcome = ChunkOutcome()
        with open_store(self._settings.database_url) as store:
            try:
                plan = stored_plan(store.engine, recording_id)
                recording = self._recording(plan, source)
                done = set()
                describers = self._describers_of(store, plan, recording)
                for item in work_off(
                    recording,
                    recording_id,
                    store,
                    describers,
                    frames=frames,
                    stop=stop,
                    descriptor_dtype=self._settings.descriptor_dtype,
                ):
                    done.add(item.claim.frame_index)
                    outcome.stored += item.created
                    outcome.lost += item.lost
                    if item.error is not None and not item.lost:
                        outcome.failed[item.claim.frame_index] = item.error
                    note(item)
                outcome.left = tuple(frame for frame in frames if frame not in done) if stop() else ()
                outcome.complete = store.finish_recording(recording_id) == "complete"
            except NotFoundError:
                return outcome  # deleted: there is nothing to do any more
        return outcome

    def _recording(self, plan: StoredPlan, source: str) -> Recording:
        key = (plan.recording_id, source, plan.fingerprint)
        if self._opened is not None and self._opened[0] == key and self._opened[1].path.is_dir():
            return self._opened[1]
        self._opened = None
        address, camera = parse_source(source)
        folder = locate(address, self._settings)
        if not folder.is_dir():
            raise RecordingUnavailableError(
                f"{folder}: there is no such folder on this machine; workers must see recordings under the path, or "
                "URL, that was given to `semdb ingest --queue`"
            )
        [recording] = open_recordings(folder, camera)
        known = {entry.index: entry for entry in recording.entries}
        entries = [known[index] for index in plan.frame_indexes if index in known]
        if len(entries) == len(plan.frame_indexes) and fingerprint(recording, entries) != plan.fingerprint:
            raise UsageError(
                f"{folder}: on this machine it is another recording than the one that was planned: its camera, or "
                "times or poses of keyframes differ"
            )
        self._opened = (key, recording)
        return recording

    def _describers_of(self, store: Store, plan: StoredPlan, recording: Recording) -> list[Describer]:
        models = store.map_models(plan.map_id)
        specs: ModelSpecs = specs_for_ingest(self._settings, models, has_masks=recording.categories is not None)
        own = settings_of_map(self._settings, models)
        key = (specs, own.model_dump_json(exclude={"database_url", "reader_url", "broker_url"}))
        if key not in self._describers:
            self._describers = {key: make_describers(specs, own)}  # of one map at a time: networks are large
        return self._describers[key]
