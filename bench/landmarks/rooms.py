"""Rendered rooms as keyframes for the computation of landmarks, with exact masks or with mistakes, and the truth."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from semdb.geometry import pose_from, so3_exp, transform_points
from semdb.landmarks.appearance import colours_of
from semdb.landmarks.boxes import Box
from semdb.landmarks.build import SeenKeyframe
from semdb.landmarks.lift import SeenObject, lift_keyframe
from semdb.landmarks.options import LandmarkOptions
from semdb.perception.box_masks import box_mask, depth_cluster_mask
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.recordings.synthetic.mistakes import MISNAMED, make_mistakes, with_misnamed
from semdb.recordings.synthetic.options import FOCAL_PER_WIDTH
from semdb.refinement.confusion import MILLION, PlacedObjects, co_detections, confusions
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ImageArray

LEAST_SIDE = 0.03  # metres
SMALLEST = 60  # pixels: a mask of fewer is none
Rng = np.random.Generator
MASK, BY_DEPTH, BOX = "masks", "boxes, by depth", "whole boxes"


@dataclass(frozen=True, slots=True)
class Mistakes:
    """What is spoiled: shares of objects missed and misnamed, share of masks cut (each loses 5 to 40 %), pose noise
    (root mean square of its length and angle), and whether depth has a sensor's noise and holes. `shape` is what is
    known of a mask: all of it, its box filled by depth, or its box alone.
    """

    missed: float = 0.0
    confused: float = 0.0
    cut: float = 0.0
    position_m: float = 0.0
    rotation_deg: float = 0.0
    depth_noise: bool = False
    shape: str = MASK


EXACT = Mistakes()
SPOILED = Mistakes(0.3, 0.15, 0.3, 0.01, 0.5)
SPOILED_NOISY = Mistakes(0.3, 0.15, 0.3, 0.01, 0.5, True)
NOISY = Mistakes(depth_noise=True)


@dataclass(frozen=True, slots=True, eq=False)
class RoomFrame:
    """One keyframe as rendered: depth in metres, 0 for none."""

    pose: FloatArray  # [4, 4]
    labels: npt.NDArray[np.uint16]  # [H, W]
    depth: Float32Array  # [H, W] exact
    noisy: Float32Array  # [H, W]
    rgb: ImageArray  # [H, W, 3]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedRoom:
    """A room with its keyframes; `axes` of each labelled thing: columns are its own axes in the map."""

    seed: int
    camera: Camera
    classes: dict[int, str]
    axes: dict[int, FloatArray]
    frames: tuple[RoomFrame, ...]


@dataclass(frozen=True, slots=True, eq=False)
class RenderedVisit:
    """A visit of a room: where its things stand ``[4, 4]`` by label, which of them were moved, and which taken away."""

    room: RenderedRoom
    places: dict[int, FloatArray]
    moved: tuple[int, ...]
    taken: tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TrueThing:
    """A thing as it is: the box of its surface that at least two keyframes see, how many keyframes show it."""

    category: str
    box: Box
    keyframes: int


def rooms_parser(what: str | None, rooms: int = 10) -> argparse.ArgumentParser:
    """The arguments of a bench over rendered rooms of successive seeds; the first line of `what` says what it is."""
    parser = argparse.ArgumentParser(description=(what or "").splitlines()[0])
    parser.add_argument("--rooms", type=int, default=rooms)
    parser.add_argument("--first", type=int, default=410)
    parser.add_argument("--keyframes", type=int, default=24)
    parser.add_argument("--width", type=int, default=640)
    return parser


def render_room(
    seed: int,
    keyframes: int = 24,
    width: int = 640,
    place: int = 0,
    laps: int = 1,
    height: int | None = None,
    focal: float = FOCAL_PER_WIDTH,
) -> RenderedRoom:
    """The room of a seed, seen from `keyframes` places on `laps` ways round it; `focal` is per width."""
    lap = max(8, keyframes // laps)
    size = {"width": width, "height": height or width * 3 // 4}
    shared = {"frames": keyframes, "lap_frames": lap, "room_seed": seed, "seed": seed, "place": place, **size}
    return _rendered(SyntheticOptions(**shared, focal=focal))[0]


def render_visit(seed: int, keyframes: int, width: int, taken: float | None) -> RenderedVisit:
    """A visit of the room of a seed: the first, or with `taken` the second, that share of small things taken away."""
    second = {} if taken is None else {"second_visit": True, "taken": taken}
    size = {"width": width, "height": width * 3 // 4}
    options = SyntheticOptions(frames=keyframes, lap_frames=max(8, keyframes), room_seed=seed, seed=seed, **size)
    room, sequence = _rendered(replace(options, **second))
    places = {item.label: item.pose for item in sequence.room.items if item.category is not None}
    return RenderedVisit(room, places, sequence.moved, sequence.taken)


def _rendered(options: SyntheticOptions) -> tuple[RenderedRoom, SyntheticSequence]:
    clean, noisy = (SyntheticSequence(replace(options, noise=noise)) for noise in (False, True))
    frames = []
    for index in range(options.frames):
        view, seen = clean.render(index), noisy.render(index)
        frames.append(RoomFrame(view.world_from_camera, view.labels, view.depth, seen.depth, view.rgb))
    axes = {item.label: item.pose[:3, :3] for item in clean.room.items if item.category is not None}
    return RenderedRoom(options.room_seed, clean.camera, clean.classes, axes, tuple(frames)), clean


def class_numbers(rooms: Sequence[RenderedRoom]) -> dict[str, int]:
    """A number for every name that a thing may go by."""
    names = {name for room in rooms for name in with_misnamed(room.classes).values()}
    return {name: number for number, name in enumerate(sorted(names))}


def seen_keyframes(
    room: RenderedRoom,
    numbers: dict[str, int],
    mistakes: Mistakes,
    options: LandmarkOptions | None = None,
    recording: int = 0,
) -> tuple[list[SeenKeyframe], list[list[int]]]:
    """The keyframes as a detector with these mistakes sees them, and the label of each of their objects."""
    options = options or LandmarkOptions()
    names, found, labels = with_misnamed(room.classes), [], []
    for index, frame in enumerate(room.frames):
        rng = np.random.default_rng([room.seed, index, 11])
        objects, true = [], []
        depth = frame.noisy if mistakes.depth_noise else frame.depth
        for label, mask in _seen_masks(room, index, mistakes, rng):
            objects.append(SeenObject(numbers[names[label]], 0.9, shaped(mask, depth, mistakes.shape)))
            true.append(label % MISNAMED)
        pose = moved_pose(frame.pose, mistakes, rng)
        lifted = lift_keyframe(room.camera, pose, depth, objects, options.lift, options.see)
        category = np.array([thing.category for thing in objects], np.int64)
        scores, colours = np.full(len(objects), 0.9), colours_of(frame.rgb, lifted)
        found.append(SeenKeyframe(lifted, category, scores, recording, colours=colours))
        labels.append(true)
    return found, labels


def _seen_masks(room: RenderedRoom, index: int, mistakes: Mistakes, rng: Rng) -> Iterator[tuple[int, BoolArray]]:
    seen = make_mistakes(room.frames[index].labels, room.classes, mistakes.missed, mistakes.confused, room.seed, index)
    for label in np.unique(seen[seen > 0]).tolist():
        mask = seen == label
        if np.count_nonzero(mask) >= SMALLEST:
            yield label, cut_mask(mask, rng) if rng.random() < mistakes.cut else mask


def seen_boxes(room: RenderedRoom, mistakes: Mistakes) -> list[FloatArray]:
    """Of each keyframe the boxes ``[o, 4]`` (pixels, the last inside) of the objects of `seen_keyframes`."""
    found = []
    for index in range(len(room.frames)):
        masks = _seen_masks(room, index, mistakes, np.random.default_rng([room.seed, index, 11]))
        found.append(np.array([mask_box(mask) for _, mask in masks], np.float64).reshape(-1, 4))
    return found


def mask_box(mask: BoolArray) -> FloatArray:
    """x1, y1, x2, y2 ``[4]`` of a mask ``[H, W]`` that is somewhere, the last inside."""
    v, u = np.nonzero(mask)
    return np.array([u.min(), v.min(), u.max(), v.max()], np.float64)


def confusion_of(keyframes: Sequence[SeenKeyframe], classes: int) -> FloatArray:
    """Shares ``[classes, classes]`` of what goes by another name, as `semdb refine` finds them of the objects."""
    number, category, centre, half = [], [], [], []
    for index, frame in enumerate(keyframes):
        for name, sighting in zip(frame.category.tolist(), frame.lifted.sighting_of.tolist(), strict=True):
            points = frame.lifted.points[sighting]
            if len(points):
                number.append(index)
                category.append(name)
                centre.append(transform_points(frame.lifted.world_from_camera, np.median(points, axis=0)[None])[0])
                half.append(float(np.linalg.norm(np.subtract(*np.percentile(points, (95, 5), axis=0)))) / 2)
    placed = PlacedObjects(np.array(number), np.array(category), np.array(centre).reshape(-1, 3), np.array(half))
    shares = np.zeros((classes, classes))
    for one in confusions(co_detections(placed, classes)):
        shares[one.category, one.other] = one.weight / MILLION
    return shares


def shaped(mask: BoolArray, depth: Float32Array, shape: str) -> BoolArray:
    """What a detector knows of `mask` ``[H, W]`` that gives it so."""
    if shape == MASK:
        return mask
    v, u = np.nonzero(mask)
    box = np.array([u.min(), v.min(), u.max(), v.max()])
    return box_mask(box, (mask.shape[0], mask.shape[1])) if shape == BOX else depth_cluster_mask(box, depth)


def cut_mask(mask: BoolArray, rng: Rng) -> BoolArray:
    """`mask` without what lies beyond a line: 5 to 40 % of its pixels."""
    v, u = np.nonzero(mask)
    angle = rng.uniform(0, 2 * np.pi)
    along = u * np.cos(angle) + v * np.sin(angle)
    beyond = along > np.quantile(along, rng.uniform(0.6, 0.95))
    found = mask.copy()
    found[v[beyond], u[beyond]] = False
    return found


def moved_pose(pose: FloatArray, mistakes: Mistakes, rng: Rng) -> FloatArray:
    """`pose` ``[4, 4]`` with noise of position and rotation."""
    shift = rng.normal(0, mistakes.position_m / np.sqrt(3), 3)
    turn = rng.normal(0, np.radians(mistakes.rotation_deg) / np.sqrt(3), 3)
    return pose_from(pose[:3, :3] @ so3_exp(turn), pose[:3, 3] + shift)


def true_things(room: RenderedRoom, step: int = 2, cell: float = 0.02) -> dict[int, TrueThing]:
    """The things of a room by label, from exact depth, masks and poses.

    No side of a box is shorter than `LEAST_SIDE`: of a book in a shelf the back alone is seen, and has no thickness.
    """
    seen: dict[int, list[FloatArray]] = {}
    counts: dict[int, int] = {}
    camera = room.camera
    v, u = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step]
    for frame in room.frames:
        labels, z = frame.labels[v, u], frame.depth[v, u].astype(np.float64)
        rays = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=-1)
        world = rays @ frame.pose[:3, :3].T + frame.pose[:3, 3]
        for label, number in zip(*np.unique(frame.labels, return_counts=True), strict=True):
            if label and number >= SMALLEST:
                counts[int(label)] = counts.get(int(label), 0) + 1
        for label in np.unique(labels[labels > 0]).tolist():
            seen.setdefault(label, []).append(world[labels == label])
    found = {}
    for label, parts in seen.items():
        points = np.concatenate(parts)
        views = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        _, cells = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True)
        pairs = np.unique(np.stack([cells.ravel(), views]), axis=1)
        several = np.bincount(pairs[0])[cells.ravel()] >= 2
        axes = room.axes[label]
        own = (points[several] if np.count_nonzero(several) >= 8 else points) @ axes
        low, high = own.min(axis=0), own.max(axis=0)
        box = Box(axes @ ((low + high) / 2), np.maximum(high - low, LEAST_SIDE), axes)
        found[label] = TrueThing(room.classes[label], box, counts.get(label, 0))
    return found
