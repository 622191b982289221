"""Step ``poses``: keyframes whose poses disagree with their images, made consistent. Off unless it is asked for."""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from sqlalchemy import Connection

from semdb.database.moving import move_within
from semdb.database.pose_records import Link, LinkKind, LinkState, Move, OperationKind
from semdb.database.records import StoredKeyframe
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError, UsageError
from semdb.exchange.source import decoded
from semdb.localization.views import ClassNumbers, make_view
from semdb.recordings.images import decode_color_grey
from semdb.trajectory.depth_views import DepthView, depth_view
from semdb.trajectory.keyframes import Keyframe, Keyframes, sample_of, with_points_only
from semdb.trajectory.refining import LOOKING, PoseOptions, between_recordings, refine_keyframes
from semdb.types import FloatArray, ImageArray

KIND = "poses"
MOST = 2000  # keyframes, all of which are in memory: about 2 MiB each
RECORDINGS_APART_S = 1e6
PROVENANCE = "semdb refine"


@dataclass(frozen=True, slots=True, eq=False)
class PoseResult:
    """Poses before and after by keyframe id, covariances, and closures."""

    before: Mapping[int, FloatArray]
    after: Mapping[int, FloatArray]
    covariances: Mapping[int, FloatArray]
    links: tuple[Link, ...]
    counted: int  # keyframes of the map
    token: str  # tells a commit whose answer was lost from one that did not happen


@dataclass(frozen=True, slots=True)
class PoseStep:
    """Poses that agree with what the images say."""

    options: PoseOptions = field(default_factory=PoseOptions)
    kind: str = KIND
    summary: str = "poses that agree with their images"
    by_default: bool = False
    moves: bool = True  # the state of the map is another one when it is done

    @property
    def parameters(self) -> Mapping[str, Any]:
        parameters = asdict(self.options)
        parameters["trajectory"].pop("threads")  # no number of threads changes a result
        return dict(json.loads(json.dumps(parameters)))  # as the database gives them back

    def compute(self, store: Store, map_id: int, progress: Callable[[int, int], None]) -> PoseResult:
        """Raises UsageError for a map that is too large, NotFoundError where a keyframe is deleted meanwhile."""
        listed = [item.id for item in store.listed_keyframes(map_id)]
        if len(listed) > MOST:
            raise UsageError(f"--step {KIND} takes maps of at most {MOST} keyframes, and this one has {len(listed)}")
        keyframes, known = _load(store, listed, progress)
        recordings = [one.recording_id for one in known]
        first = [n == 0 or recordings[n] != recordings[n - 1] for n in range(len(known))]

        def told(what: str, done: int, total: int) -> None:
            before, share = (10, 50) if what == LOOKING else (60, 40)
            progress(before + share * done // max(total, 1), 100)

        found = refine_keyframes(keyframes, first, self.options, told)
        edges = between_recordings(found.closures, recordings)
        spread = {one.id: found.covariances[n] for n, one in enumerate(known)}
        return PoseResult(
            before={one.id: one.world_from_camera for one in known},
            after={one.id: found.poses[n] for n, one in enumerate(known)},
            covariances={key: value for key, value in spread.items() if np.isfinite(value).all() and value.any()},
            links=tuple(
                Link(
                    known[edge.first].id,
                    known[edge.second].id,
                    LinkKind(edge.kind.value),
                    edge.first_from_second,
                    edge.information,
                    edge.inliers,
                    LinkState(edge.state.value),
                    edge.reason,
                    PROVENANCE,
                )
                for edge in edges
            ),
            counted=len(listed),
            token=secrets.token_hex(8),
        )

    def write(self, connection: Connection, map_id: int, result: PoseResult) -> int:
        """Moves the keyframes. Raises DatabaseError where one was moved meanwhile."""
        wanted = Move(
            OperationKind.REFINE,
            map_id,
            result.before,
            result.after,
            links=result.links,
            covariances=result.covariances,
            counted=result.counted,
        )
        move_within(connection, wanted, result.token)
        return len(result.after)


def _load(
    store: Store, listed: Sequence[int], progress: Callable[[int, int], None]
) -> tuple[Keyframes, list[StoredKeyframe]]:
    """Keyframes as a trajectory has them, damaged ones left out aloud."""
    numbers, keyframes, known = ClassNumbers(), Keyframes(), list[StoredKeyframe]()
    starts: dict[int, float] = {}
    for done, key in enumerate(listed, 1):
        progress(10 * done // len(listed), 100)
        found = store.load_keyframes([key], bad=store.left_out)
        ids, vectors = store.vectors_there(np.array([key], np.int64), bad=store.left_out)
        if not found or not len(ids):
            continue
        [one] = found
        grey, depth = _images(store, one)
        names = [thing.category for thing in one.objects]
        view = with_points_only(make_view(one.camera, one.keypoints, names, numbers, grey=grey))
        start = starts.setdefault(one.recording_id, len(starts) * RECORDINGS_APART_S)
        keyframes.add(
            Keyframe(len(known), len(known), start + _seconds(one), 0, view, vectors[0], sample_of(view), depth),
            one.world_from_camera,
        )
        known.append(one)
    return keyframes, known


def _seconds(one: StoredKeyframe) -> float:
    return one.frame_index / 30 if one.timestamp_ns is None else one.timestamp_ns % 10**14 / 1e9


def _images(store: Store, one: StoredKeyframe) -> tuple[ImageArray | None, DepthView | None]:
    """The image in grey and thinned depth; None for what cannot be decoded."""
    image = store.load_image(one.id)
    try:
        grey = decode_color_grey(image.rgb, f"keyframe_images.rgb of keyframe {one.id}")
        head = store.keyframe_heads_of([one.id])[0]
        return grey, depth_view(one.camera, decoded(image, head)[1])
    except (FrameError, CodecError) as error:
        store.left_out(one.id, CodecError(str(error)))
        return None, None
