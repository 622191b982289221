"""Ingest by a fleet: plans go into the database, messages name keyframes of them, workers do what a message says.

The database holds the truth. A message may be lost, for `sweep` sends another, or arrive twice, for a keyframe is
claimed before it is worked on. Whoever does a message sends on what it has not seen done: else keyframes stay planned
that nothing names. Nothing here knows how messages travel: `send` is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field

from semdb.database import items
from semdb.database.items import OpenItem, open_items
from semdb.database.planning import StoredPlan, check_models, stored_plan
from semdb.database.records import RowOptions
from semdb.database.requeue import requeue_failed
from semdb.database.store import Store, open_store
from semdb.errors import ModelError, NotFoundError, UsageError
from semdb.ingestion.estimation import posed
from semdb.ingestion.planned import open_planned
from semdb.ingestion.run import (
    IngestOptions,
    IngestSummary,
    Progress,
    keep_findings,
    look_first,
    make_describers,
    map_models_of,
    open_all,
    plan_ingest,
)
from semdb.ingestion.work import Item, work_off
from semdb.perception.describe import Describer
from semdb.perception.model_choice import ModelSpecs, settings_of_map, specs_for_ingest
from semdb.recordings.base import Recording
from semdb.refinement.error_step import measure_recording
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
    store: Store | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> list[IngestSummary]:
    """Plans every recording under `paths` and sends its keyframes; nothing is described here.

    Without `store` that of the settings is opened. Raises as `ingest_recordings` does, and what `send` raises: then the
    plan is in the database and `sweep` sends it.
    """
    summaries = []
    opening = open_store(settings.database_url, create=True) if store is None else nullcontext(store)
    with opening as opened:
        for recording in open_all(paths, settings, options, progress):
            known = map_models_of(opened, options.map_of(recording))
            specs = specs_for_ingest(settings, known, has_masks=recording.categories is not None)
            for note in (*recording.said, *specs.notes):
                if say is not None:
                    say(f"{recording.name}: {note}")
            posed_so = posed(recording, opened, options.map_of(recording), options.poses, progress=progress, say=say)
            warnings = look_first(posed_so.recording, opened, settings, options, progress, say)
            one = settings_of_map(settings, known).model_copy(update={"threads": 1})
            models = make_describers(specs, one)[0].models
            summary, _ = plan_ingest(posed_so, opened, models, options, progress=progress)
            summary.notes = (*recording.said, *specs.notes)
            keep_findings(opened, summary, warnings)
            requeue_failed(opened.engine, summary.recording_id)
            sweep(opened, send, recording_id=summary.recording_id)
            opened.finish_recording(summary.recording_id)
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
            try:
                send(queued.recording_id, queued.source, chunk)
            except BaseException:
                items.mark_sent(store.engine, queued.recording_id, chunk, 0)  # the next sweep need not wait
                raise
            sent += len(chunk)
    return sent


def chunks(indexes: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """`indexes` in parts of the size of a message."""
    for start in range(0, len(indexes), CHUNK):
        yield tuple(indexes[start : start + CHUNK])


def parts(found: Sequence[OpenItem]) -> list[tuple[int, ...]]:
    """The free ones of `found` in parts that are worked off one after the other.

    First those that nobody has begun, together. Then those that were begun before, each alone, and what was begun most
    often last: one that hangs or kills its workers takes no other along, and holds up none but its like.
    """
    free = [item for item in found if not item.held]
    fresh = tuple(item.frame_index for item in free if item.attempts == 0)
    begun = sorted((item.attempts, item.frame_index) for item in free if item.attempts > 0)
    return ([fresh] if fresh else []) + [(index,) for _, index in begun]


@dataclass(slots=True)
class ChunkOutcome:
    """What became of the keyframes of one message. What is `left` or `held` is for the caller to send again.

    `left`: free and not done, as the worker was to stop; they are marked as sent. `held`: another worker is at them,
    or was and died, which only its lease tells. `gone`: there is no such recording.
    """

    stored: int = 0
    failed: dict[int, str] = field(default_factory=dict)
    lost: int = 0
    left: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    complete: bool = False
    gone: bool = False


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

        Where the recording is, the database says: `source`, which was sent, is not asked.

        Where none is open the recording need not be there. One that was deleted gives an outcome that says `gone`.
        Raises RecordingUnavailableError for one that cannot be seen here now, RecordingError for one that is another
        here than where it was planned, or that cannot be read, UsageError for one that may not be read here,
        ProvenanceError where this worker has other models, ModelError where it has none, DatabaseError.
        """
        outcome = ChunkOutcome()
        with open_store(self._settings.database_url) as store:
            try:
                plan = stored_plan(store.engine, recording_id)
                items.release_dead(store.engine, recording_id)
                found = open_items(store.engine, recording_id, frames)
                if any(not item.held for item in found):
                    self._work_off(store, plan, found, outcome, stop, note)
                    found = open_items(store.engine, recording_id, frames)
                outcome.held = tuple(item.frame_index for item in found if item.held)
                outcome.left = tuple(item.frame_index for item in found if not item.held)
                if outcome.left:
                    items.mark_sent(store.engine, recording_id, outcome.left, MESSAGE_WAIT_S)
                outcome.complete = store.finish_recording(recording_id) == "complete"
                if outcome.complete:
                    measure_recording(store, recording_id, changed=outcome.stored > 0)
            except NotFoundError:
                outcome.gone = True  # deleted: there is nothing to do any more
        return outcome

    def give_up(self, recording_id: int, frames: Sequence[int], error: str) -> int:
        """Calls those of `frames` failed that are still to be done and that nobody has. Returns how many these are."""
        with open_store(self._settings.database_url) as store:
            number = items.give_up(store.engine, recording_id, frames, error)
            store.finish_recording(recording_id)
        return number

    def _work_off(
        self,
        store: Store,
        plan: StoredPlan,
        found: list[OpenItem],
        outcome: ChunkOutcome,
        stop: Callable[[], bool],
        note: Callable[[Item], None],
    ) -> None:
        """Until nothing of `found` is free: a claim whose commit was answered by nobody is only seen when it ended."""
        recording = self._recording(store, plan)
        describers = self._describers_of(store, plan, recording)
        frames = [item.frame_index for item in found]
        progress = True
        while progress and not stop():
            progress = False
            for part in parts(found):
                for item in work_off(
                    recording,
                    plan.recording_id,
                    store,
                    describers,
                    frames=part,
                    stop=stop,
                    rows=RowOptions(self._settings.descriptor_dtype, self._settings.keep_images),
                ):
                    progress = True
                    outcome.stored += item.created
                    outcome.lost += item.lost
                    if item.error is not None and not item.lost:
                        outcome.failed[item.claim.frame_index] = item.error
                    note(item)
                if stop():
                    return
            found = open_items(store.engine, plan.recording_id, frames)

    def _recording(self, store: Store, plan: StoredPlan) -> Recording:
        key = (plan.recording_id, plan.source, plan.fingerprint)
        if self._opened is not None and self._opened[0] == key and self._opened[1].path.exists():
            return self._opened[1]
        self._opened = None
        recording = open_planned(
            store,
            plan,
            self._settings,
            "workers must see recordings under the path or URL that was given to `semdb ingest --queue`",
        )
        self._opened = (key, recording)
        return recording

    def _describers_of(self, store: Store, plan: StoredPlan, recording: Recording) -> list[Describer]:
        models = store.map_models(plan.map_id)
        own = settings_of_map(self._settings, models)
        try:
            specs: ModelSpecs = specs_for_ingest(self._settings, models, has_masks=recording.categories is not None)
            key = (specs, own.model_dump_json(exclude={"database_url", "reader_url", "broker_url"}))
            if key not in self._describers:
                self._describers = {key: make_describers(specs, own)}  # of one map at a time: networks are large
        except UsageError as error:
            raise ModelError(f"this worker has not the models: {error}") from error
        check_models(models, self._describers[key][0].models, "the map")  # before keyframes are claimed in vain
        return self._describers[key]
