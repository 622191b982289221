"""What needs more than one keyframe: each step reads rows of a map, computes, and replaces a table of its own.

A step is a function of what the map holds, and of nothing else: not of row ids, nor of the order of ingest, nor of the
server. So it can be run at any time and as often as one likes, beside ingest and deletion; what it wrote belongs to the
state of the map that it read, and is out of date when the map has another (`semdb.database.refinements`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sqlalchemy.exc import IntegrityError

from semdb.database.landmark_parts import forget_parts
from semdb.database.records import MapInfo
from semdb.database.store import Store
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.refinement.step import Step
from semdb.refinement.steps import LANDMARKS, STEPS

ATTEMPTS = 3  # of a step while the map changes under it
Progress = Callable[[str, int, int], None]  # what, done, total


@dataclass(frozen=True, slots=True)
class StepResult:
    """What a step did. `computed` False: it was up to date; `current` False: the map changed meanwhile."""

    map_name: str
    kind: str
    summary: str
    rows: int
    computed: bool
    current: bool


def refine_map(
    store: Store,
    info: MapInfo,
    *,
    kinds: Sequence[str] = (),
    force: bool = False,
    progress: Progress | None = None,
) -> list[StepResult]:
    """Runs the steps that are out of date (with `force` all, and from nothing), of the named `kinds` or of all.

    Raises UsageError for a kind that is none, NotFoundError when the map is deleted meanwhile, DatabaseError when it
    never holds still.
    """
    results = []
    for step in steps_of(kinds):
        known = {item.kind: item for item in store.refinements(info.id)}.get(step.kind)
        if known is not None and known.current and known.parameters == dict(step.parameters) and not force:
            results.append(StepResult(info.name, step.kind, step.summary, known.rows, computed=False, current=True))
            continue
        if force and step.kind == LANDMARKS:
            forget_parts(store.engine, info.id)
        rows, current = _run(store, info, step, progress)
        results.append(StepResult(info.name, step.kind, step.summary, rows, computed=True, current=current))
    return results


def steps_of(kinds: Sequence[str]) -> list[Step]:
    """The steps of these kinds, without any all that are run by default. Raises UsageError for a kind that is none."""
    known = [step.kind for step in STEPS]
    for kind in kinds:
        if kind not in known:
            raise UsageError(f"--step {kind}: known are {', '.join(known)}")
    return [step for step in STEPS if (step.kind in kinds if kinds else step.by_default)]


def _run(store: Store, info: MapInfo, step: Step, progress: Progress | None) -> tuple[int, bool]:
    """Computes and writes one step; again when the map changed meanwhile. Rows, and whether they are of its state."""

    def show(done: int, total: int) -> None:
        if progress is not None:
            progress(f"{info.name}: {step.summary}", done, total)

    failure: Exception | None = None
    for attempt in range(1, ATTEMPTS + 1):
        state = store.map_state(info.id)
        try:
            result = step.compute(store, info.id, show)
        except NotFoundError as error:  # a keyframe was deleted after the map was listed
            failure = error
            continue
        same = store.map_state(info.id) == state
        if not same and attempt < ATTEMPTS:
            continue
        try:
            before = None if step.moves else state
            rows = store.replace_refinement(info.id, step.kind, before, step.parameters, step.write, result)
        except IntegrityError as error:  # the result refers to a keyframe that was deleted after the map was read
            failure = error
            continue
        return rows, step.moves or store.map_state(info.id) == state
    raise DatabaseError(
        f"the map {info.name!r} kept changing while it was refined ({step.summary}): run semdb refine when ingest and "
        "deletion are done"
    ) from failure
