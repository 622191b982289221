"""Keyframes of one map as the fine step wants them, the latest kept in memory."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from semdb.database.links import load_covariances
from semdb.database.pose_errors import load_pose_errors
from semdb.database.records import StoredKeyframe
from semdb.database.refinements import POINTS
from semdb.database.store import Store
from semdb.errors import CodecError, FrameError, NotFoundError
from semdb.geometry import POSE_UNIT_M, pose_distances
from semdb.geometry.sensor import depth_noise
from semdb.localization.coarse import MapChange
from semdb.localization.edges import PlacedEdges
from semdb.localization.fallback import Fallback, fallback_cache
from semdb.localization.frame_cache import FrameCache
from semdb.localization.landmark_pose import MapLandmarks
from semdb.localization.map_landmarks import read_map_landmarks
from semdb.localization.predicted_view import PlacedView, SmallView, best_seen
from semdb.localization.shape_cache import (
    Local,
    ShapeCache,
    There,
    depth_cache,
    edge_cache,
    surface_cache,
    view_cache,
)
from semdb.localization.surface_alignment import PlacedSurfaces
from semdb.localization.views import ClassNumbers, KeyframeView, make_keyframe_view
from semdb.recordings.images import decode_color_grey, has_size
from semdb.types import Float32Array, FloatArray, ImageArray, Keypoints, PoseErrors

FAR_VIEWS, ASKED_VIEWS = 30.0, 24  # of `pose_distances`, and keyframes: who looks along a corridor sees far
FAR_SHAPES = 12.0  # of `pose_distances`: keyframes further off show nothing that a query could lie on
USED, STALE, NONE, OFF = "used", "stale", "none", "off"  # what becomes of its points


class KeyframeCache:
    """Loads keyframes from the database and keeps the `capacity` last used (about 1.3 MiB each).

    With `refined` their points are those of `semdb refine`, as long as these belong to what the map holds, with
    `frames` there are those that it keeps beside them. Threads may share it: they take turns.
    """

    def __init__(
        self,
        store: Store,
        map_id: int,
        capacity: int = 64,
        *,
        refined: bool = True,
        fallback: Fallback | None = None,
        frames: bool = True,
    ) -> None:
        self.numbers = ClassNumbers()
        self._turn = threading.RLock()
        self.store = store
        self._map_id = map_id
        self._capacity = capacity
        self._views: OrderedDict[int, KeyframeView] = OrderedDict()
        self._names: dict[int, tuple[str, int]] = {}
        self._recordings: dict[int, int] = {}  # by keyframe
        self._poses: tuple[list[int], FloatArray] | None = None
        self._stale: set[int] = set()  # keyframes whose poses are to be read again
        self._surfaces, self._edges = surface_cache(store), edge_cache(store)
        self._frames = FrameCache(store, map_id, self.numbers) if frames else None
        self._small_views = view_cache(store)
        self.fallback = fallback
        self._others = None if fallback is None else fallback_cache(store, fallback, self.numbers)
        self._depths = depth_cache(store)
        self._landmarks: MapLandmarks | None = None
        self._landmarks_read = False
        self._refined = refined
        self._points: str | None = None if refined else OFF
        self._pose_errors: dict[int, PoseErrors] | None = None  # by recording
        self.left_out: dict[int, CodecError] = {}  # keyframes that cannot be used

    @property
    def points(self) -> str:
        """What becomes of refined points: ``used``, ``stale`` (the map has changed since), ``none`` or ``off``."""
        with self._turn:
            if self._points is None:
                known = [item for item in self.store.refinements(self._map_id) if item.kind == POINTS]
                self._points = NONE if not known else USED if known[0].current else STALE
            return self._points

    def forget(self, change: MapChange) -> None:
        """Drops what is out of date; poses of added keyframes are read when they are asked for."""
        with self._turn:
            self._forget(change)

    def measured_anew(self) -> None:
        """How far recorded poses are off is read again when it is next asked for."""
        with self._turn:
            self._pose_errors = None

    def _forget(self, change: MapChange) -> None:
        if self._refined:
            if self._points == USED:
                self._views.clear()  # their points belong to the map as it was
            self._points = None
        self._pose_errors = None
        if self._frames is not None:
            self._frames.forget()
        self._landmarks, self._landmarks_read = None, False
        gone = None if change.everything else change.added | change.gone
        for shapes in (self._surfaces, self._edges, self._depths, self._small_views):
            shapes.forget(gone)
        if self._others is not None:
            self._others.forget(gone)
        if change.everything:
            self._views.clear()
            self._names.clear()
            self._recordings.clear()
            self.left_out.clear()
            self._poses = None
            return
        for keyframe_id in change.gone:
            self.left_out.pop(keyframe_id, None)
            self._views.pop(keyframe_id, None)
            self._names.pop(keyframe_id, None)
            self._recordings.pop(keyframe_id, None)
        if self._poses is not None:
            self._stale |= change.added | change.gone

    def views(
        self, keyframe_ids: Sequence[int], descriptors: npt.NDArray[np.generic] | None = None
    ) -> list[KeyframeView]:
        """Views in the order of `keyframe_ids`; a keyframe that was deleted meanwhile, or is damaged, is left out.

        So is one that has not such `descriptors` ``[m, d]`` as it is to be compared with.
        """
        with self._turn:
            self._load([i for i in keyframe_ids if i not in self._views])
            found = []
            for keyframe_id in keyframe_ids:
                view = self._views.get(keyframe_id)
                if view is not None and self._is_comparable(view, descriptors):
                    self._views.move_to_end(keyframe_id)
                    found.append(self._with_errors(view))
            while len(self._views) > self._capacity:
                self._views.popitem(last=False)
            return found

    def fallback_views(self, keyframe_ids: Sequence[int]) -> list[KeyframeView]:
        """As `views`, with keypoints of the fallback; a keyframe without depth is left out. Raises ModelError."""
        if self._others is None:
            return []
        found = []
        for own in self.views(keyframe_ids):
            with self._turn:
                view = self._others.placed(own.keyframe_id, own.world_from_camera)
            if view is not None:
                found.append(replace(view, pose_sigma=own.pose_sigma, pose_errors=own.pose_errors))
        return found

    def with_depth(self, keyframe_ids: Sequence[int]) -> list[KeyframeView]:
        """As `views`, with the inverse depth of their small images; a keyframe without depth is left out."""
        found = []
        for own in self.views(keyframe_ids):
            with self._turn:
                depth = self._depths.placed(own.keyframe_id, own.world_from_camera)
            if depth is not None:
                found.append(replace(own, view=replace(own.view, inverse_depth=depth.inverse)))
        return found

    def frames_near(
        self, pose: FloatArray, limit: float, count: int, descriptors: npt.NDArray[np.generic]
    ) -> list[KeyframeView]:
        """The `count` frames beside the keyframes that are nearest to `pose`, as `near`. Their ids are negative.

        One that has not such `descriptors` as it is to be compared with is left out.
        """
        if self._frames is None:
            return []
        with self._turn:
            if not self._frames:  # most maps: where their keyframes are need not be read
                return []
            ids, poses = self._read_poses()
            found = self._frames.near(pose, limit, count, ids, poses)
            errors = self._known_errors()
            return [
                replace(one, pose_errors=errors.get(self._frames.head(one.keyframe_id).recording_id))
                for one in found
                if _are_comparable(one.view.descriptors, descriptors)
            ]

    def _load(self, missing: Sequence[int]) -> None:
        if not missing:
            return
        refined = self.store.refined_points(missing, self.store.left_out) if self.points == USED else {}
        sure = load_covariances(self.store.engine, missing, self.store.left_out)
        for stored in self._stored(missing):
            self._names[stored.id] = (stored.recording, stored.frame_index)
            self._recordings[stored.id] = stored.recording_id
            try:
                keypoints, looser = with_refined(stored.keypoints, refined.get(stored.id), stored.id)
            except CodecError as error:
                self.store.left_out(stored.id, error)
                keypoints, looser = stored.keypoints, None
            self._views[stored.id] = make_keyframe_view(
                stored.id,
                stored.camera,
                stored.world_from_camera,
                keypoints,
                [found.category for found in stored.objects],
                self.numbers,
                self._grey(stored),
                looser,
                sure.get(stored.id),
            )

    def _with_errors(self, view: KeyframeView) -> KeyframeView:
        """The same with what is known of its recording now, which may be measured after its keyframes were read."""
        errors = self._known_errors().get(self._recordings[view.keyframe_id])
        if view.pose_errors != errors:
            view = self._views[view.keyframe_id] = replace(view, pose_errors=errors)
        return view

    def _known_errors(self) -> dict[int, PoseErrors]:
        if self._pose_errors is None:
            self._pose_errors = load_pose_errors(self.store.engine, self._map_id, lambda _, error: self._say(error))
        return self._pose_errors

    def _say(self, error: CodecError) -> None:
        if self.store.say is not None:
            self.store.say(f"how far recorded poses are off is left out, run semdb refine --force: {error}")

    def _stored(self, keyframe_ids: Sequence[int]) -> list[StoredKeyframe]:
        try:
            return self.store.load_keyframes(keyframe_ids, bad=self._leave_out) if keyframe_ids else []
        except NotFoundError:
            if len(keyframe_ids) == 1:
                return []  # deleted since the coarse step proposed it
            return [found for keyframe_id in keyframe_ids for found in self._stored([keyframe_id])]

    def _is_comparable(self, keyframe: KeyframeView, descriptors: npt.NDArray[np.generic] | None) -> bool:
        own = keyframe.view.descriptors
        if descriptors is None:
            return True
        if _are_comparable(own, descriptors):
            return True
        where = f"descriptors.data of keyframe {keyframe.keyframe_id}"
        theirs = f"{descriptors.dtype} with {descriptors.shape[1]}"
        error = CodecError(f"{where}: {own.dtype} with {own.shape[1]} numbers, and the query has {theirs}")
        self._leave_out(keyframe.keyframe_id, error)
        return False

    def _leave_out(self, keyframe_id: int, error: CodecError) -> None:
        self.left_out[keyframe_id] = error
        self.store.left_out(keyframe_id, error)

    def _grey(self, stored: StoredKeyframe) -> ImageArray | None:
        """The keyframe's image in grey; None where it cannot be decoded or is not what the camera took."""
        where = f"keyframe_images.rgb of keyframe {stored.id}"
        try:
            data = self.store.load_image(stored.id).rgb
            if not has_size(data, (stored.camera.width, stored.camera.height)):
                return None
            return decode_color_grey(data, where)
        except NotFoundError:  # deleted a moment ago
            return None
        except (FrameError, CodecError) as error:
            self.store.left_out(stored.id, CodecError(str(error)))
            return None

    def name_of(self, keyframe_id: int) -> tuple[str, int]:
        """Recording and frame index of a keyframe that was loaded."""
        return self._names.get(keyframe_id, ("", -1))

    def near(
        self,
        pose: FloatArray,
        limit: float,
        without: Collection[int],
        count: int | None = None,
        among: Sequence[int] | None = None,
    ) -> tuple[list[int], FloatArray]:
        """Ids and poses ``[n, 4, 4]`` of the `count` keyframes nearest to `pose`, nearest first, but for `without`.

        They are less than `limit` away (`pose_distances`); those equally far in the order of `among`, which may be
        some of the map's, or of their ids.
        """
        ids, poses = self.poses()
        if among is not None:
            place = {key: n for n, key in enumerate(ids)}
            ids = [key for key in among if key in place]
            poses = poses[[place[key] for key in ids]]
        # the distance is at least that of the positions alone: turns are worked out for few
        close = np.flatnonzero(((poses[:, :3, 3] - pose[:3, 3]) ** 2).sum(axis=1) < (limit * POSE_UNIT_M) ** 2)
        distance = pose_distances(pose, poses[close])
        order = [int(n) for n in np.argsort(distance, kind="stable") if distance[n] < limit]
        rows = [close[n] for n in order if ids[close[n]] not in without][:count]
        return [ids[n] for n in rows], poses[rows]

    def surfaces_near(self, pose: FloatArray, count: int) -> list[PlacedSurfaces]:
        """Surfaces of the `count` keyframes nearest to `pose` that have depth, or fewer, in the world."""
        return self._shapes_near(self._surfaces, pose, count)

    def edges_near(self, pose: FloatArray, count: int) -> list[PlacedEdges]:
        """Edges of the `count` keyframes nearest to `pose` that have depth, or fewer, in the world."""
        return self._shapes_near(self._edges, pose, count)

    def views_seen_from(self, pose: FloatArray, query: SmallView, count: int) -> tuple[list[PlacedView], bool]:
        """Of the keyframes about `pose` that have depth the `count` that show most of what `query` would see there.

        And whether one about it has none.
        """
        ids, poses = self.near(pose, FAR_VIEWS, (), ASKED_VIEWS)
        found = []
        for keyframe_id, world_from_camera in zip(ids, poses, strict=True):
            with self._turn:  # images are decoded: others get their turn in between
                found.append(self._small_views.placed(keyframe_id, world_from_camera))
        return best_seen([view for view in found if view is not None], pose, query, count), None in found

    def small_views(self, keyframes: Sequence[KeyframeView]) -> list[PlacedView]:
        """What those of `keyframes` show that have depth."""
        with self._turn:
            own = [one for one in keyframes if one.keyframe_id > 0]  # of frames beside keyframes no depth is kept
            found = [self._small_views.placed(one.keyframe_id, one.world_from_camera) for one in own]
            return [view for view in found if view is not None]

    def edges_of(self, views: Sequence[PlacedView]) -> list[PlacedEdges]:
        """The edges of the keyframes that `views` are of, in their order."""
        with self._turn:
            found = [self._edges.placed(view.keyframe_id, view.world_from_camera) for view in views]
            return [edges for edges in found if edges is not None]

    def _shapes_near(self, shapes: ShapeCache[Local, There], pose: FloatArray, count: int) -> list[There]:
        with self._turn:
            ids, poses = self.near(pose, FAR_SHAPES, (), 2 * count)
            placed: list[There] = []
            for keyframe_id, world_from_camera in zip(ids, poses, strict=True):
                found = shapes.placed(keyframe_id, world_from_camera)
                if found is not None:
                    placed.append(found)
                if len(placed) == count:
                    break
            return placed

    def landmarks(self) -> MapLandmarks | None:
        """The confirmed landmarks of the map; None where it has none, or which way is up cannot be read."""
        with self._turn:
            if not self._landmarks_read:
                try:
                    self._landmarks = read_map_landmarks(self.store, self._map_id, *self._read_poses())
                except CodecError:  # those who ask for landmarks are told; an image has its answer without
                    self._landmarks = None
                self._landmarks_read = True
            return self._landmarks

    def distances(self, pose: FloatArray, keyframe_ids: Sequence[int]) -> FloatArray:
        """How far keyframes are from `pose` (`pose_distances`); zero for one that is not there any more."""
        ids, poses = self.poses()
        at = [bisect_left(ids, keyframe_id) for keyframe_id in keyframe_ids]
        known = [n < len(ids) and ids[n] == keyframe_id for n, keyframe_id in zip(at, keyframe_ids, strict=True)]
        found = np.zeros(len(at))
        found[known] = pose_distances(pose, poses[[n for n, there in zip(at, known, strict=True) if there]])
        return found

    def poses(self) -> tuple[list[int], FloatArray]:
        """Ids, ascending, and ``world_from_camera`` ``[n, 4, 4]`` of all keyframes of the map."""
        with self._turn:
            return self._read_poses()

    def _read_poses(self) -> tuple[list[int], FloatArray]:
        if self._poses is None:
            self._poses = self.store.poses(self._map_id, bad=self.store.left_out)
        elif self._stale:
            ids = np.array(self._poses[0], np.int64)
            kept = ~np.isin(ids, list(self._stale))
            new_ids, new_poses = self.store.poses(self._map_id, sorted(self._stale), self.store.left_out)
            ids = np.concatenate([ids[kept], np.array(new_ids, np.int64)])
            order = np.argsort(ids, kind="stable")
            self._poses = ids[order].tolist(), np.concatenate([self._poses[1][kept], new_poses])[order]
        self._stale.clear()
        return self._poses


def _are_comparable(one: npt.NDArray[np.generic], other: npt.NDArray[np.generic]) -> bool:
    alike = one.dtype == other.dtype or {one.dtype.name, other.dtype.name} == {"float32", "int8"}
    return alike and one.shape[1] == other.shape[1]


def with_refined(
    keypoints: Keypoints, refined: Float32Array | None, keyframe_id: int
) -> tuple[Keypoints, Float32Array | None]:
    """`keypoints` ``[n]`` with the points of `refined` ``[n, 4]`` where there are any.

    Also how many times the sensor's noise the depth of each has (at least once). Raises CodecError.
    """
    if refined is None:
        return keypoints, None
    if len(refined) != len(keypoints):
        raise CodecError(
            f"refined_points of keyframe {keyframe_id}: {len(refined)} points for {len(keypoints)} keypoints; "
            "run semdb refine --force"
        )
    found = np.isfinite(refined[:, 2])
    points = np.where(found[:, None], refined[:, :3], keypoints.points).astype(np.float32)
    excess = np.where(found, refined[:, 3] / depth_noise(points[:, 2].astype(np.float64)), 1.0)
    return replace(keypoints, points=points), np.maximum(excess, 1.0).astype(np.float32)
