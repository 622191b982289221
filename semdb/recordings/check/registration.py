"""Whether edges of depth lie on those of colour, or would in another size or place, or at another time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.recordings.check.edges import EdgeFrame, misfit
from semdb.recordings.check.pairs import Pair
from semdb.types import FloatArray

ZOOMS = np.arange(0.8, 1.251, 0.05)
SHIFTS = np.arange(-15.0, 15.1, 5.0)  # pixels of an image of 320
LEAST_FRAMES, LEAST_POINTS = 5, 2000  # in all
BETTER = 0.8  # the misfit must fall to this share
LEAST_ZOOM, LEAST_SHIFT = 0.05, 7.0  # what is less is calibration
DELAYS_S = np.arange(-0.3, 0.301, 0.01)
LEAST_DELAY_S = 0.04
DELAY_BETTER = 0.88
WINDOW_S = 0.1  # about a delay by the flow in which depth images themselves are tried
FINE_STEP_S = 0.05  # at most between depth images for that
GRID_S = np.arange(-0.075, 0.076, 0.005)

DepthEdgesAt = Callable[[int, float], tuple[float, FloatArray] | None]
"""Edges ``[n, 2]`` of the depth image nearest to a time in seconds after that of a frame, and how much later it is."""


@dataclass(frozen=True, slots=True)
class Misplaced:
    """How depth must be changed to lie on colour: stretched, moved (pixels of an image of 640), or `delay_s` alone."""

    zoom: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)
    delay_s: float = 0.0  # positive: depth is later than colour


def misplaced(
    pairs: Sequence[Pair],
    edges: Mapping[int, EdgeFrame],
    steps_s: FloatArray,
    depth_edges_at: DepthEdgesAt | None = None,
) -> Misplaced | None:
    """What would make depth fit colour far better; None where nothing does, or there is too little to tell.

    A delay is found by the flow of the images; with `depth_edges_at` depth images around it then say it finer.
    """
    frames = [edges[pair.first] for pair in pairs if pair.first in edges]
    if len(frames) < LEAST_FRAMES or sum(len(frame.points) for frame in frames) < LEAST_POINTS:
        return None
    nothing = np.zeros((len(frames), 2))
    as_is = misfit(frames, 1.0, nothing)
    late = _delay(pairs, edges, steps_s)
    if late is not None and late[1] < DELAY_BETTER * as_is:
        fine = None if depth_edges_at is None else _fine_delay(pairs, edges, late[0], depth_edges_at)
        return Misplaced(delay_s=late[0] if fine is None else fine)
    zoom, shift, least = _place(frames)
    far = abs(zoom - 1) >= LEAST_ZOOM or float(np.hypot(*shift)) >= LEAST_SHIFT
    if not far or least > BETTER * as_is:
        return None
    return Misplaced(zoom, (2 * shift[0], 2 * shift[1]))


def _place(frames: Sequence[EdgeFrame]) -> tuple[float, tuple[float, float], float]:
    """Zoom, shift (of 320) and misfit of the best place."""

    def tried(zooms: FloatArray, xs: FloatArray, ys: FloatArray) -> tuple[float, float, float, float]:
        return min(
            (misfit(frames, zoom, np.tile((x, y), (len(frames), 1))), zoom, x, y)
            for zoom in zooms.tolist()
            for x in xs.tolist()
            for y in ys.tolist()
        )

    _, zoom, x, y = tried(ZOOMS, SHIFTS, SHIFTS)
    near = np.array([-2.5, 0.0, 2.5])
    least, zoom, x, y = tried(zoom + 0.01 * near, x + near, y + near)
    return zoom, (x, y), least


def _delay(pairs: Sequence[Pair], edges: Mapping[int, EdgeFrame], steps_s: FloatArray) -> tuple[float, float] | None:
    """The delay at which depth edges, moved back by the flow of the images, fit best, and the misfit there."""
    used = [(pair, step) for pair, step in zip(pairs, steps_s, strict=True) if pair.first in edges and 0 < step < 0.5]
    if len(used) < LEAST_FRAMES:
        return None
    frames = [edges[pair.first] for pair, _ in used]
    speed = np.stack([np.median(pair.flow_px, axis=0) / step / 2 for pair, step in used])  # pixels of 320 a second
    if float(np.median(np.hypot(*speed.T))) < 20:
        return None
    scores = [misfit(frames, 1.0, -speed * delay) for delay in DELAYS_S]
    least = int(np.argmin(scores))
    return None if abs(DELAYS_S[least]) < LEAST_DELAY_S else (float(DELAYS_S[least]), float(scores[least]))


def _fine_delay(
    pairs: Sequence[Pair], edges: Mapping[int, EdgeFrame], rough_s: float, depth_edges_at: DepthEdgesAt
) -> float | None:
    """The delay near `rough_s` at which depth images of other times lie on colour; None where they are too sparse.

    An image that is late shows what an earlier neighbour should, so neighbours are looked at on the other side.
    """
    steps = np.arange(-WINDOW_S, WINDOW_S + 1e-9, FINE_STEP_S / 2)
    curves = []
    for index in [pair.first for pair in pairs if pair.first in edges]:
        near = dict(found for step in steps if (found := depth_edges_at(index, step - rough_s)) is not None)
        later = np.array(sorted(near))
        if len(later) < 3 or float(np.diff(later).max()) > FINE_STEP_S:
            continue
        scores = [misfit([EdgeFrame(near[t], edges[index].distance)], 1.0, np.zeros((1, 2))) for t in later.tolist()]
        curves.append(np.interp(GRID_S - rough_s, later, scores, left=np.nan, right=np.nan))
    whole = [curve for curve in curves if np.isfinite(curve).all()]
    if len(whole) < LEAST_FRAMES:
        return None
    return float(rough_s - GRID_S[int(np.argmin(np.mean(whole, axis=0)))])
