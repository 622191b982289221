"""Lifted keyframes as arrays and back, so that they are lifted once."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from semdb.landmarks.lift import Grids, LiftedKeyframe
from semdb.landmarks.memo import Arrays
from semdb.types import Camera, Float32Array, FloatArray

LIFT, GRID = "lift", "grid"  # kinds of what is remembered: what is small of a keyframe, and what is large


def lift_arrays(lifted: LiftedKeyframe, colours: Float32Array | None) -> dict[str, Arrays]:
    """What is to be remembered of a keyframe, by kind; `colours` ``[sightings, n]`` see `appearance`."""
    points, counts = _joined(lifted.points)
    outline, outline_counts = _joined(lifted.outline)
    small: dict[str, np.ndarray] = {
        "sighting_of": lifted.sighting_of,
        "points": points,
        "counts": counts,
        "areas": lifted.areas,
        "beside": lifted.beside,
        "cut": lifted.cut,
        "single": lifted.single,
        "numbers": np.array([lifted.step, lifted.noise, lifted.farthest], np.float64),
    }
    if colours is not None:
        small["colours"] = colours
    large = {"outline": outline, "counts": outline_counts, "depth": lifted.grid_depth, "owner": lifted.grid_owner}
    return {LIFT: small, GRID: large}


def lifted_from(
    camera: Camera, world_from_camera: FloatArray, name: str, small: Arrays, grids: Callable[[], Grids]
) -> tuple[LiftedKeyframe, Float32Array | None]:
    """A keyframe as it was lifted, and its colours; `grids` gives what is large when it is asked for."""
    step, noise, farthest = small["numbers"].tolist()
    lifted = LiftedKeyframe(
        camera=camera,
        world_from_camera=np.asarray(world_from_camera, np.float64),
        sighting_of=small["sighting_of"],
        points=_split(small["points"], small["counts"]),
        areas=small["areas"],
        beside=small["beside"],
        cut=small["cut"],
        grids=grids,
        step=int(step),
        noise=noise,
        single=small["single"],
        farthest=farthest,
        name=name,
    )
    return lifted, small.get("colours")


def grids_from(large: Arrays) -> Grids:
    """What is large of a keyframe."""
    return Grids(_split(large["outline"], large["counts"]), large["depth"], large["owner"])


def _joined(parts: Sequence[Float32Array]) -> tuple[Float32Array, np.ndarray]:
    counts = np.array([len(part) for part in parts], np.int32)
    return np.concatenate([np.empty((0, 3), np.float32), *parts]), counts


def _split(points: Float32Array, counts: np.ndarray) -> tuple[Float32Array, ...]:
    return tuple(np.split(points, np.cumsum(counts)[:-1])) if len(counts) else ()
