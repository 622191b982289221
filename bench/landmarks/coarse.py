"""Poses by landmarks alone: how many are right, and how many images of other places get one.

``python -m bench.landmarks.coarse rendered [--rooms N] [--first SEED]``: rooms of 24 keyframes and 24 images between
them with the mistakes of `bench.landmarks` in both and noisy depth, as if no keypoint agreed; each room's images are
foreign to the others. Masks come from the renderer: paint changes none of them, in the dark `bench.trust` keeps 40 % of
those that are left and in blur 60 %, and another camera sees 78 degrees from left to right in 480x270 pixels. Seeds
300 to 303 and 400 to 403 were tuned on.

``python -m bench.landmarks.coarse real URL MAP RECORDING [--foreign RECORDING] [--queries N] [--all]``: images of a
recording that are no keyframes, and of another one, in a tenth of the light and blurred over 25 pixels, through a whole
query; the map has to be refined, and the detector to be that of the map. Counted are those whose keypoints fail; with
--all no keypoint is looked at, images as they are are asked too, and all count.

An image *shows* a landmark where a detection of its name covers what should be seen of it (IoU 0.3) from the true pose.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bench.landmarks.rooms import (
    SMALLEST,
    SPOILED_NOISY,
    RenderedRoom,
    class_numbers,
    confusion_of,
    cut_mask,
    mask_box,
    render_room,
    seen_boxes,
    seen_keyframes,
)
from bench.trust.images import Picture, blurred, darkened
from semdb.database.landmark_reading import StoredLandmark
from semdb.geometry import invert_pose, pose_error
from semdb.landmarks.boxes import upright_axes
from semdb.landmarks.build import find_landmarks
from semdb.landmarks.sizes import sizes_of
from semdb.landmarks.values import Landmarks
from semdb.localization.landmark_kernels import LEAST_INSIDE, predict
from semdb.localization.landmark_pose import (
    LandmarkPose,
    LandmarkPoseOptions,
    MapLandmarks,
    SeenThings,
    find_pose,
    things_of,
)
from semdb.localization.landmark_step import things_in
from semdb.localization.map_landmarks import SightingBoxes, map_landmarks
from semdb.perception.objects import object_geometry
from semdb.recordings.synthetic.mistakes import make_mistakes, with_misnamed
from semdb.refinement.confusion import MILLION
from semdb.types import Camera, Detection, FloatArray

OPTIONS = LandmarkPoseOptions()
SHOWN, NEAR_M, NEAR_DEG = 4, 0.5, 10.0
SAME_IOU, LEAST_NAME = 0.3, -1.0
OTHER = "another camera"
KINDS = {"repainted": 1.0, "blurred": 0.6, "dark": 0.4, OTHER: 1.0}  # share of masks that are kept


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """An image asked of a map: how many landmarks it shows, what was given, the errors where it is of the place."""

    kind: str
    shown: int
    given: bool
    errors: tuple[float, float] | None  # None: it shows another place
    variance: float = float("nan")  # error of the position squared over its variance, of three numbers

    @property
    def is_right(self) -> bool:
        return self.given and self.errors is not None and self.errors[0] <= NEAR_M and self.errors[1] <= NEAR_DEG


def shown_landmarks(things: SeenThings, landmarks: MapLandmarks, world_from_camera: FloatArray) -> int:
    """How many landmarks an image shows, one detection each."""
    camera, box, taken = invert_pose(world_from_camera), np.empty(4), set()
    for m in range(len(landmarks)):
        if predict(landmarks.corners[m], landmarks.centres[m], camera, things.frame, box) < LEAST_INSIDE:
            continue
        for d, seen in enumerate(things.boxes):
            if d in taken or landmarks.names[m, things.category[d]] < LEAST_NAME:
                continue
            low, high = np.maximum(seen[:2], box[:2]), np.minimum(seen[2:], box[2:])
            shared = np.prod(np.maximum(high - low, 0))
            if shared > SAME_IOU * (np.prod(seen[2:] - seen[:2]) + np.prod(box[2:] - box[:2]) - shared):
                taken.add(d)
                break
    return len(taken)


def case_of(
    kind: str, things: SeenThings, landmarks: MapLandmarks, found: LandmarkPose | None, true: FloatArray | None
) -> Case:
    given = found is not None and not found.doubt(OPTIONS)
    if true is None:
        return Case(kind, 0, given, None)
    shown = shown_landmarks(things, landmarks, true)
    if found is None:
        return Case(kind, shown, False, (np.inf, np.inf))
    off = found.world_from_camera[:3, 3] - true[:3, 3]
    variance = float(off @ np.linalg.solve(found.covariance[:3, :3], off))
    return Case(kind, shown, given, pose_error(found.world_from_camera, true), variance)


def stored(found: Landmarks, names: Sequence[str]) -> list[StoredLandmark]:
    """Landmarks as they would be read from a database."""
    axes = upright_axes(found.gravity.up)
    rows = []
    for number, one in enumerate(found.landmarks):
        first = one.box.axes[:, 0] @ axes
        evidence = {names[k]: float(share) for k, share in enumerate(one.evidence) if share >= 0.0005}
        x, y, z = (float(value) for value in one.box.centre)
        a, b, c = (float(value) for value in one.box.size)
        rows.append(
            StoredLandmark(
                *(number, names[one.category], one.probability, evidence, (x, y, z), one.covariance, (a, b, c)),
                *(float(np.arctan2(first[1], first[0])), len(one.members), one.keyframes, one.missed),
                *(one.seen_through, str(one.state), None, None, None, None),
            )
        )
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class RoomImages:
    """A rendered room as a map, and detections of one kind of images between its keyframes with their true poses."""

    kind: str
    landmarks: MapLandmarks
    camera: Camera
    seen: list[tuple[list[tuple[Detection, FloatArray]], FloatArray]]


def room_landmarks(room: RenderedRoom) -> MapLandmarks:
    """The landmarks of the map that all frames of a room make."""
    numbers, mistakes = class_numbers([room]), SPOILED_NOISY
    names = list(numbers)
    keyframes, _ = seen_keyframes(room, numbers, mistakes)
    found = find_landmarks(keyframes, len(numbers), sizes=sizes_of(list(numbers)))
    poses = np.stack([frame.pose for frame in room.frames])
    shares = np.rint(confusion_of(keyframes, len(numbers)) * MILLION).astype(np.int64)
    mixed = {names[k]: {names[o]: int(row[o]) for o in np.flatnonzero(row)} for k, row in enumerate(shares)}
    boxes = seen_boxes(room, mistakes)
    members = [(number, one) for number, of in enumerate(found.landmarks) for one in of.members]
    seen = SightingBoxes(
        np.array([number for number, _ in members], np.int64),
        np.array([one.keyframe for _, one in members], np.int64),
        np.array([boxes[one.keyframe][one.ordinal] for _, one in members]).reshape(-1, 4),
    )
    landmarks = map_landmarks(stored(found, names), poses, found.gravity.up, room.camera, mixed, seen)
    if landmarks is None:
        raise SystemExit(f"room {room.seed} has no landmark")
    return landmarks


def room_images(seed: int) -> list[RoomImages]:
    """A room's map with images of each kind."""
    whole, other = render_room(seed, 48, 480), render_room(seed, 48, 480, height=270, focal=0.62)
    landmarks = room_landmarks(replace(whole, frames=whole.frames[::2]))
    return [_images(kind, other if kind == OTHER else whole, landmarks, kept) for kind, kept in KINDS.items()]


def _images(kind: str, whole: RenderedRoom, landmarks: MapLandmarks, kept: float) -> RoomImages:
    mistakes, seed = SPOILED_NOISY, whole.seed
    names, images = with_misnamed(whole.classes), []
    for index, frame in enumerate(whole.frames[1::2]):
        rng, lost = np.random.default_rng([seed, index, 77]), np.random.default_rng([seed, index, 78])
        labels = make_mistakes(frame.labels, whole.classes, mistakes.missed, mistakes.confused, seed + 1000, index)
        depth = np.where(frame.noisy > 0, frame.noisy, np.nan).astype(np.float32)
        things = []
        for label in np.unique(labels[labels > 0]).tolist():
            mask = labels == label
            if np.count_nonzero(mask) < SMALLEST:
                continue
            if rng.random() < mistakes.cut:
                mask = cut_mask(mask, rng)
            if lost.random() > kept:
                continue
            one = Detection(names[label], 0.9, mask_box(mask).astype(np.float32), mask)
            things.append((one, object_geometry(whole.camera, depth, one).centroid))
        images.append((things, frame.pose))
    return RoomImages(kind, landmarks, whole.camera, images)


def rendered(first: int, rooms: int) -> Iterator[Case]:
    made = [room_images(seed) for seed in range(first, first + rooms)]
    for of_map in (of_room[0] for of_room in made):
        for of_images in (images for of_room in made for images in of_room):
            for seen, pose in of_images.seen:
                if not seen:
                    continue
                for with_depth in (True, False):
                    points = np.stack([point if with_depth else np.full(3, np.nan) for _, point in seen])
                    things = things_of(
                        *(of_images.camera, [one.category for one, _ in seen]),
                        *(np.stack([one.box for one, _ in seen]).astype(np.float64), np.full(len(seen), 0.9), points),
                        *(of_map.landmarks, OPTIONS),
                    )
                    found = find_pose(things, of_map.landmarks, OPTIONS)
                    kind = f"{of_images.kind}, {'depth' if with_depth else 'colour alone'}"
                    own = of_map.landmarks is of_images.landmarks
                    yield case_of(kind, things, of_map.landmarks, found, pose if own else None)


def real(
    database: str, map_name: str, recordings: Sequence[tuple[str, bool]], queries: int, every_image: bool
) -> Iterator[Case]:
    from semdb.database.store import open_store
    from semdb.localization.images import make_localizer
    from semdb.localization.landmark_step import landmark_pose
    from semdb.perception.describe import describer_from_specs
    from semdb.perception.model_choice import specs_for_query
    from semdb.recordings import open_recordings
    from semdb.settings import Settings
    from semdb.types import Verdict

    with open_store(database) as store:
        info, settings = store.find_map(map_name), Settings()
        specs = specs_for_query(settings, store.map_models(info.id))
        describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
        localizer = make_localizer(store, info, "index")
        landmarks = localizer.cache.landmarks()
        if landmarks is None:
            raise SystemExit(f"map {map_name} has no landmarks: semdb refine")
        keyframes = localizer.cache.poses()[1][:, :3, 3]
        for path, is_own in recordings:
            recording = open_recordings(path)[0]
            known = [e for e in recording.entries if e.world_from_camera is not None]
            rest = [e for e in known if np.linalg.norm(keyframes - e.world_from_camera[:3, 3], axis=1).min() > 1e-6]
            for entry in [rest[round(k)] for k in np.linspace(0, len(rest) - 1, queries)]:
                picture = Picture(recording.read_image(entry), recording.camera, None)
                rng = np.random.default_rng(entry.index)
                spoiled = {"a tenth of the light": darkened(picture, rng, 0.1), "blur": blurred(picture, rng, 25)}
                if every_image:
                    spoiled["as it is"] = picture
                for name, image in spoiled.items():
                    whole = describer.describe(image.image, recording.read_depth(entry), picture.camera)
                    for described in (whole, without_depth(whole)):
                        failed = (Verdict.FAILED, Verdict.COARSE)
                        if not every_image and localizer.localize(described).verdict not in failed:
                            continue
                        things = things_in(described, landmarks, OPTIONS)
                        found = landmark_pose(described, landmarks, OPTIONS)
                        kind = f"{name}, {'colour alone' if described.depth is None else 'depth'}"
                        yield case_of(kind, things, landmarks, found, entry.world_from_camera if is_own else None)


def without_depth(described):  # type: ignore[no-untyped-def]
    """A description as if there had been no depth."""
    nowhere = tuple(replace(one, centroid=np.full(3, np.nan)) for one in described.geometry)
    points = np.full_like(described.keypoints.points, np.nan)
    keypoints = replace(described.keypoints, points=points)
    return replace(described, geometry=nowhere, keypoints=keypoints, depth=None)


def report(cases: Sequence[Case]) -> None:
    head = (
        "asked",
        "show 4",
        "right",
        "share",
        "given",
        "wrong",
        "foreign",
        "given",
        "share",
        "NEES",
        "in 50%",
        "in 95%",
    )
    print(f"{'':36}" + "".join(f"{name:>9}" for name in head))
    for kind in sorted({case.kind for case in cases}):
        own = [case for case in cases if case.kind == kind and case.errors is not None]
        foreign = [case for case in cases if case.kind == kind and case.errors is None]
        shown = [case for case in own if case.shown >= SHOWN]
        given = [case for case in own if case.given]
        right, taken = sum(case.is_right for case in shown), sum(case.given for case in foreign)
        variance = np.array([case.variance for case in given] or [np.nan])
        spread = (f"{np.median(variance):.1f}", *(f"{np.mean(variance < bound):.2f}" for bound in (2.366, 7.815)))
        numbers = (len(own), len(shown), right, f"{right / max(len(shown), 1):.2f}", len(given))
        rest = (sum(not case.is_right for case in given), len(foreign), taken, f"{taken / max(len(foreign), 1):.4f}")
        print(f"{kind:36}" + "".join(f"{value:>9}" for value in (*numbers, *rest, *spread)))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    kinds = parser.add_subparsers(dest="kind", required=True)
    rooms = kinds.add_parser("rendered")
    rooms.add_argument("--rooms", type=int, default=4)
    rooms.add_argument("--first", type=int, default=400)
    recorded = kinds.add_parser("real")
    recorded.add_argument("database")
    recorded.add_argument("map")
    recorded.add_argument("recording")
    recorded.add_argument("--foreign", action="append", default=[])
    recorded.add_argument("--queries", type=int, default=60)
    recorded.add_argument("--all", action="store_true")
    given = parser.parse_args()
    if given.kind == "rendered":
        report(list(rendered(given.first, given.rooms)))
    else:
        asked = [(given.recording, True), *((path, False) for path in given.foreign)]
        report(list(real(given.database, given.map, asked, given.queries, given.all)))


if __name__ == "__main__":
    main()
