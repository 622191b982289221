"""Which frames of a recording become keyframes: those with the least view in common."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import cv2
import numpy as np

from semdb.errors import FrameError, RecordingError, UsageError
from semdb.geometry import pose_distances
from semdb.perception.quality import sharpness_of
from semdb.recordings.base import FrameEntry, Recording
from semdb.types import Camera, FloatArray, IntArray

# Gives one keyframe in 9 frames of freiburg1_rpy (5 Hz) and one in 15 of 7-Scenes' red kitchen (7.5 Hz).
MIN_OVERLAP = 0.7

LIKE_CAMERA = 0.05  # of the focal length, by which cameras of frames may differ; depth is compared within 10 %

NEAR_EQUAL = 0.12  # of `pose_distances`: about 95 % of the view is in common
NEAR = 6  # frames that are looked at beside each
MUCH_SHARPER = 1.25  # as much gradient; frames of one quality differ by less

Progress = Callable[[int, int], None]
OverlapWith = Callable[[int, FloatArray], FloatArray]


def select_keyframes(
    recording: Recording,
    *,
    count: int | None = None,
    stride: int | None = None,
    keep: Sequence[FrameEntry] = (),
    min_overlap: float = MIN_OVERLAP,
    progress: Progress | None = None,
) -> list[FrameEntry]:
    """The keyframes of a recording in ascending index; the same call always gives the same frames.

    With `count` exactly that many: each next one is the frame whose greatest common view with the chosen ones is
    least. With `stride` every stride-th frame. With neither, as many as it takes until every frame has a common
    view of at least `min_overlap` with some keyframe, of frames that see nearly the same the sharpest. `keep`, but
    for a stride, are keyframes already: they are among those that are returned, and the others are chosen by what they
    have in common with these. Frames without a pose are
    never keyframes; frames whose depth cannot be decoded go to ``recording.decode_failures``. `progress` gets (frames
    read, frames).
    Raises UsageError for a count or stride that makes no sense, RecordingError when no frame has a pose.
    """
    if count is not None and stride is not None:
        raise UsageError("give either a number of keyframes or a stride, not both")
    if count is not None and count < 1:
        raise UsageError(f"the number of keyframes must be at least 1, but is {count}")
    if stride is not None and stride < 1:
        raise UsageError(f"the stride must be at least 1, but is {stride}")
    entries = [entry for entry in recording.entries if entry.world_from_camera is not None]
    if not entries:
        raise RecordingError(f"{recording.whereabouts}: no frame has a pose, so none can become a keyframe")
    if stride is not None:
        return entries[::stride]
    entries, overlap_with = _compare_views(recording, entries, progress)
    kept = {entry.index for entry in keep}
    lost = [entry for entry in keep if entry.index not in {other.index for other in entries}]
    if count is not None and count > len(entries) + len(lost):
        raise UsageError(
            f"{recording.whereabouts}: {count} keyframes were asked for, but only "
            f"{len(entries) + len(lost)} frames can be used"
        )
    if not entries:
        raise RecordingError(f"{recording.whereabouts}: no depth image can be decoded")
    poses = np.stack([entry.world_from_camera for entry in entries if entry.world_from_camera is not None])
    first = [i for i, entry in enumerate(entries) if entry.index in kept] or [0]
    left = None if count is None else count - len(lost)
    chosen = farthest_views(
        overlap_with, poses, count=left, first=first, min_overlap=min_overlap,
        prefer=_Sharpest(recording, entries, poses, kept) if count is None else None,
    )  # fmt: skip
    return sorted([*lost, *(entries[i] for i in chosen.tolist())], key=lambda entry: entry.index)


def farthest_views(
    overlap_with: OverlapWith,
    poses: FloatArray,
    *,
    count: int | None,
    first: Sequence[int] = (0,),
    min_overlap: float = MIN_OVERLAP,
    prefer: Callable[[int], int] | None = None,
) -> IntArray:
    """Indices of views in the order they are chosen, `first` first, which are no more than `count`.

    `prefer` gives another view to be taken in place of one.

    ``overlap_with(i, floor)`` gives the common view ``[n]`` of all with view i (values up to `floor` need not be
    exact). Of views with equally little in common with the chosen ones the farthest in pose ``[n, 4, 4]`` is
    taken, then the lowest index. Stops at `count`, or without one when all have at least `min_overlap`.
    """
    n = len(poses)
    greatest = np.full(n, -1.0)
    distance = np.full(n, np.inf)
    chosen: list[int] = []
    while True:
        current = first[len(chosen)] if len(chosen) < len(first) else int(np.lexsort((-distance, greatest))[0])
        current = current if prefer is None else prefer(current)
        chosen.append(current)
        greatest = np.maximum(greatest, overlap_with(current, greatest))
        greatest[current] = np.inf
        distance = np.minimum(distance, pose_distances(poses[current], poses))
        if len(chosen) == (n if count is None else count) or (count is None and greatest.min() >= min_overlap):
            return np.array(chosen, dtype=np.int32)


class _Sharpest:
    """Of frames that see nearly the same as one the sharpest, where it is much sharper than that one."""

    def __init__(
        self, recording: Recording, entries: Sequence[FrameEntry], poses: FloatArray, kept: Collection[int]
    ) -> None:
        self._recording = recording
        self._entries = entries
        self._poses = poses
        self._taken = {i for i, entry in enumerate(entries) if entry.index in kept}
        self._known: dict[int, float] = {}

    def __call__(self, current: int) -> int:
        if current in self._taken:
            return current
        distance = pose_distances(self._poses[current], self._poses)
        near = [int(i) for i in np.argsort(distance, kind="stable")[: NEAR + 1] if distance[i] <= NEAR_EQUAL]
        best = max((i for i in near if i not in self._taken), key=lambda i: (self._sharpness(i), -i), default=current)
        if self._sharpness(best) < MUCH_SHARPER * self._sharpness(current):
            best = current
        self._taken.add(best)
        return best

    def _sharpness(self, number: int) -> float:
        """Zero for an image that cannot be read: whoever reads the keyframe says so."""
        if number not in self._known:
            try:
                image = self._recording.read_image(self._entries[number])
                self._known[number] = sharpness_of(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
            except FrameError:
                self._known[number] = 0.0
        return self._known[number]


def overlap_from_pose_distance(distance: FloatArray, min_overlap: float = MIN_OVERLAP) -> FloatArray:
    """A stand-in for the common view where there is no depth: 1 at distance 0, `min_overlap` at distance 1."""
    return np.asarray(min_overlap**distance)


def _alike(first: Camera, second: Camera) -> bool:
    """Whether two cameras see so much the same that one stands for the other where views are compared."""
    if (first.width, first.height) != (second.width, second.height):
        return False
    own, other = (np.array([c.fx, c.fy, c.cx, c.cy]) for c in (first, second))
    return bool((np.abs(own - other) <= LIKE_CAMERA * other[0]).all())


def _compare_views(
    recording: Recording, entries: Sequence[FrameEntry], progress: Progress | None
) -> tuple[list[FrameEntry], OverlapWith]:
    """Reads the depth of all `entries` once, and returns those that can be read and their comparison."""
    from semdb.ingestion.view_overlap import ViewStack, view_grid

    readable, grids = [], []
    camera = recording.camera  # frames of quite another one are compared by their poses
    nothing = np.full((camera.height, camera.width), np.nan, dtype=np.float32)
    for done, entry in enumerate(entries, start=1):
        try:
            depth = recording.read_depth(entry) if _alike(recording.camera_of(entry), camera) else None
        except FrameError as error:
            recording.note_decode_failure(entry, error)
        else:
            readable.append(entry)
            grids.append(view_grid(camera, nothing if depth is None else depth))
        if progress is not None:
            progress(done, len(entries))
    poses = [entry.world_from_camera for entry in readable if entry.world_from_camera is not None]
    stacked = np.stack(poses) if poses else np.empty((0, 4, 4))
    stack = ViewStack(grids, poses) if poses else None

    def overlap_with(index: int, floor: FloatArray) -> FloatArray:
        by_pose = overlap_from_pose_distance(pose_distances(stacked[index], stacked))
        if stack is None or not stack.known[index]:
            return by_pose
        return np.where(stack.known, stack.overlap_with(index, floor), by_pose)

    return readable, overlap_with
