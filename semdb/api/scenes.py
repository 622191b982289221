"""What viewers draw of a map: its keyframes, things and links in columns, its points, what shows what."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from semdb.api.surveying import Surveying
from semdb.database.pose_records import LinkState
from semdb.errors import CodecError, FrameError, NotFoundError, UsageError
from semdb.geometry import quat_wxyz_from_rotation
from semdb.types import Camera

if TYPE_CHECKING:
    from semdb.database.landmark_reading import StoredLandmark
    from semdb.database.landmark_records import LandmarkVisit
    from semdb.database.pose_records import Link
    from semdb.database.records import KeyframeHead
    from semdb.database.scene_reading import StoredSighting
    from semdb.pictures.cloud import Cloud

MOST_POINTS = 1_000_000
CLOUD_KEYFRAMES = 60  # whose images are looked at for points


class Viewing(Surveying):
    """Looks at a map as viewers draw it."""

    def scene(self, map: str) -> dict[str, Any]:
        """All keyframes, landmarks and accepted links of a map, column by column. Raises NotFoundError, CodecError."""
        from semdb.database.landmark_reading import load_landmarks
        from semdb.database.landmark_rows import load_gravity
        from semdb.database.links import list_links

        store, head = self._store(), self._head(map)
        gravity = load_gravity(store.engine, head.id)
        return {
            "map": head.name,
            "up": None if gravity is None else list(gravity.up),
            "keyframes": _keyframe_columns(store.keyframe_heads(head.id, bad=store.left_out)),
            "landmarks": _landmark_columns(load_landmarks(store.engine, head.id, store.say)[0]),
            "links": _link_columns(list_links(store.engine, head.id, odometry=False, bad=store.left_out)),
        }

    def map_state(self, map: str) -> str:
        """What a map holds, in a line: equal lines, the same keyframes at the same poses. Raises NotFoundError."""
        return self._store().map_state(self._head(map).id)

    def scene_state(self, map: str) -> str:
        """What `scene` shows, in a line that is cheap to have: equal lines, the same scene. Raises NotFoundError."""
        from semdb.database.scene_reading import scene_state

        return scene_state(self._store().engine, self._head(map).id)

    def cloud(self, map: str, points: int = 100_000) -> Cloud:
        """Up to so many coloured points of a map, of up to 60 keyframes that lie apart.

        They are of depth images; of keyframes without one, of keypoints. Raises NotFoundError, UsageError for a number
        that is none. A keyframe that cannot be read is left out, and said.
        """
        from semdb.pictures.cloud import cloud_of, spread

        if not 1 <= points <= MOST_POINTS:
            raise UsageError(f"points is between 1 and {MOST_POINTS}, not {points}")
        store, head = self._store(), self._head(map)
        heads = store.keyframe_heads(head.id, bad=store.left_out)
        poses = np.array([one.world_from_camera for one in heads]).reshape(-1, 4, 4)
        chosen = [heads[index] for index in spread(poses, CLOUD_KEYFRAMES)]
        return cloud_of(self._parts(chosen, 4 * points // max(1, len(chosen)) + 1), points)

    def _parts(self, heads: list[KeyframeHead], most: int) -> Iterator[Any]:
        from semdb.api.answers import StoredContent
        from semdb.pictures.cloud import points_of_depth, points_of_keypoints

        content = StoredContent(self._store)
        for head in heads:
            try:
                image = content.image(head.id)
                depth = content.depth(head.id, head.camera)
                if depth is not None and depth.shape == image.shape[:2]:
                    yield points_of_depth(image, depth, head.camera, head.world_from_camera, most)
                    continue
                keypoints = content.keypoints(head.id)[0]
                yield points_of_keypoints(image, keypoints.features.xy, keypoints.points, head.world_from_camera)
            except NotFoundError:
                continue  # deleted a moment ago
            except (FrameError, CodecError) as error:
                self._store().left_out(head.id, CodecError(str(error)))

    def sightings(self, map: str, landmark: int) -> list[StoredSighting]:
        """The objects that show a landmark of a map, by time. Raises NotFoundError, CodecError."""
        from semdb.database.scene_reading import sightings_of_landmark

        return sightings_of_landmark(self._store().engine, self._head(map).id, landmark)

    def visits(self, map: str, landmark: int) -> list[LandmarkVisit]:
        """What each recording of a map says of a landmark: where it was, or that it was not there or not looked at.

        Raises NotFoundError, CodecError.
        """
        from semdb.database.visit_reading import visits_of_landmark

        return visits_of_landmark(self._store().engine, self._head(map).id, landmark)

    def seen_in(self, keyframe_id: int) -> list[StoredSighting]:
        """The landmarks that a keyframe shows, with the objects that show them. Raises CodecError."""
        from semdb.database.scene_reading import sightings_in_keyframe

        return sightings_in_keyframe(self._store().engine, keyframe_id)


def _indexed(values: list[Any]) -> tuple[list[Any], list[int]]:
    """The different ones of `values` in the order of their coming, and which of them each is."""
    places: dict[Any, int] = {}
    numbers = [places.setdefault(value, len(places)) for value in values]
    return list(places), numbers


def _rounded(rows: Any, digits: int) -> list[float]:
    return [round(float(value), digits) for value in np.asarray(rows, np.float64).ravel()]


def _keyframe_columns(heads: list[KeyframeHead]) -> dict[str, Any]:
    recordings, recording = _indexed([head.recording for head in heads])
    cameras, camera = _indexed([head.camera for head in heads])
    return {
        "recordings": recordings,
        "cameras": [_camera(one) for one in cameras],
        "id": [head.id for head in heads],
        "recording": recording,
        "camera": camera,
        "frame_index": [head.frame_index for head in heads],
        "timestamp_ns": [head.timestamp_ns for head in heads],
        "position": _rounded([head.world_from_camera[:3, 3] for head in heads], 4),
        "quat_wxyz": _rounded([quat_wxyz_from_rotation(head.world_from_camera[:3, :3]) for head in heads], 5),
    }


def _camera(camera: Camera) -> dict[str, float]:
    return {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}


def _landmark_columns(found: list[StoredLandmark]) -> dict[str, Any]:
    categories, category = _indexed([one.category for one in found])
    states, state = _indexed([one.state for one in found])
    upper = np.triu_indices(3)
    return {
        "categories": categories,
        "states": states,
        "id": [one.id for one in found],
        "category": category,
        "state": state,
        "probability": _rounded([one.probability for one in found], 3),
        "position": _rounded([one.position for one in found], 4),
        "covariance": _rounded([one.covariance[upper] for one in found], 9),
        "size": _rounded([one.size for one in found], 4),
        "yaw": _rounded([one.yaw for one in found], 4),
        "keyframes": [one.keyframes for one in found],
        "last_seen_ns": [one.last_seen_ns for one in found],
    }


def _link_columns(found: list[Link]) -> dict[str, Any]:
    kept = [one for one in found if one.state is LinkState.ACCEPTED]
    kinds, kind = _indexed([one.kind.value for one in kept])
    return {
        "kinds": kinds,
        "kind": kind,
        "keyframe": [one.first for one in kept],
        "other_keyframe": [one.second for one in kept],
        "inliers": [one.inliers for one in kept],
    }
