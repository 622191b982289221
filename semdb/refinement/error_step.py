"""Step ``errors``: how far the recorded poses of each recording are off its images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from sqlalchemy import Connection

from semdb.database.pose_errors import (
    POSE_ERRORS,
    is_measured,
    keyframes_of,
    map_of,
    replace_pose_errors,
    write_pose_errors,
)
from semdb.database.store import Store
from semdb.errors import CodecError, NotFoundError
from semdb.types import PoseErrors

if TYPE_CHECKING:
    from semdb.localization.keyframe_cache import KeyframeCache
    from semdb.localization.recorded_errors import LeftOut

REVISION = 3  # of the computation: another one makes what is stored out of date
FIRST_LEAST, FIRST_MOST = 8, 16  # keyframes that are measured when a recording of so many at least is ingested


@dataclass(frozen=True, slots=True)
class ErrorOptions:
    """Keyframes are localized among their neighbours of the same recording, without their own depth."""

    most: int = 24  # that are localized of a recording, evenly over it
    neighbours: int = 5
    times: int = 3  # each: then without the nearest, and without the two nearest, which is farther off
    farthest: float = 6.0  # of `pose_distances`: further off nothing is seen in common


@dataclass(frozen=True, slots=True)
class ErrorStep:
    """How far the recorded poses of each recording are off its images."""

    options: ErrorOptions = field(default_factory=ErrorOptions)
    kind: str = POSE_ERRORS
    summary: str = "errors of recorded poses"
    by_default: bool = True
    moves: bool = False

    @property
    def parameters(self) -> Mapping[str, Any]:
        return {"revision": REVISION, **asdict(self.options)}

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> dict[int, PoseErrors]:
        recordings = keyframes_of(store.engine, map_id)
        total, done, found = sum(min(len(ids), self.options.most) for ids in recordings.values()), 0, {}
        for key, ids in recordings.items():

            def show(count: int, before: int = done) -> None:
                progress(before + count, total)

            errors = errors_of(store, map_id, ids, self.options, show)
            done += min(len(ids), self.options.most)
            if errors is not None:
                found[key] = errors
        return found

    def write(self, connection: Connection, map_id: int, result: Mapping[int, PoseErrors]) -> int:
        return replace_pose_errors(connection, map_id, result)


def measure_recording(store: Store, recording_id: int, *, changed: bool) -> None:
    """Measures and writes how far the poses of one recording are off, once it is ingested; nothing of few keyframes.

    What is there already stays unless keyframes have `changed`; where it is missing, as after a process was killed, it
    is made up for. Answers come without it, so damaged rows are no reason to fail. Raises DatabaseError.
    """
    map_id = map_of(store.engine, recording_id)
    if map_id is None or (not changed and is_measured(store.engine, recording_id)):
        return
    ids = keyframes_of(store.engine, map_id, recording_id).get(recording_id, [])
    options = ErrorOptions(most=FIRST_MOST)
    if len(ids) < FIRST_LEAST:
        return
    try:
        errors = errors_of(store, map_id, ids, options)
    except (CodecError, NotFoundError) as error:
        if store.say is not None:
            store.say(f"how far the recorded poses are off is not known, semdb refine finds it: {error}")
        return
    if errors is not None:
        write_pose_errors(store.engine, recording_id, errors)


def errors_of(
    store: Store,
    map_id: int,
    ids: Sequence[int],
    options: ErrorOptions,
    progress: Callable[[int], None] | None = None,
) -> PoseErrors | None:
    """What the keyframes `ids` of one recording, in the order of their frames, show; None where they show nothing.

    Raises NotFoundError where a keyframe is deleted meanwhile, CodecError.
    """
    from semdb.localization.keyframe_cache import KeyframeCache
    from semdb.localization.recorded_errors import measured

    # by measured points, refined or not: the numbers are of the recording, whatever steps were run before
    cache, told, found = KeyframeCache(store, map_id, refined=False), [], 0
    for count, keyframe_id in enumerate(spread_over(ids, options.most), start=1):
        here = errors_at(cache, store, map_id, keyframe_id, ids, options)
        told += here
        found += bool(here)
        if progress is not None:
            progress(count)
    return measured(told, found) if told else None


def errors_at(
    cache: KeyframeCache, store: Store, map_id: int, keyframe_id: int, ids: Sequence[int], options: ErrorOptions
) -> list[LeftOut]:
    """One keyframe localized among those of `ids` that are nearest, then among farther ones, where it is found.

    Raises CodecError where models of the map are damaged.
    """
    from semdb.localization.cross_validation import localized_farther
    from semdb.localization.localizer_options import LocalizerOptions

    known, poses = cache.poses()
    if keyframe_id not in known:
        return []
    place = poses[known.index(keyframe_id)]
    others, _ = cache.near(place, options.farthest, (keyframe_id,), options.neighbours + options.times - 1, ids)
    own, near = cache.views([keyframe_id]), cache.views(others)
    if not own or not near:
        return []
    width = own[0].view.descriptors.shape[1]  # rows of another one are damaged: the step of points says which
    keyframes = [keyframe for keyframe in near if keyframe.view.descriptors.shape[1] == width]
    if not keyframes:
        return []
    localizer = LocalizerOptions().for_models(store.map_models(map_id))
    found = localized_farther(own[0], keyframes, localizer, options.neighbours, options.times)
    return [one for one in found if one is not None]


def spread_over(ids: Sequence[int], most: int) -> list[int]:
    """At most so many of `ids`, evenly over them."""
    if len(ids) <= most:
        return list(ids)
    return [ids[n] for n in np.linspace(0, len(ids) - 1, most).round().astype(int)]
