"""Rendered patterns whose geometry is known, and how keypoints of two views of one compare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semdb.types import Features, ImageArray

HEIGHT, WIDTH = 240, 320
CENTRE = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])


@dataclass(frozen=True)
class Pattern:
    """Sum of turned Gaussian blobs: continuous, so it can be seen at any angle, scale and sub-pixel position."""

    centres: npt.NDArray[np.float64]  # [k, 2] pixels
    sigmas: npt.NDArray[np.float64]  # [k, 2] along its axes
    angles: npt.NDArray[np.float64]  # [k] radians
    heights: npt.NDArray[np.float64]  # [k] grey levels


def random_pattern(seed: int = 0, blobs: int = 70) -> Pattern:
    rng = np.random.default_rng(seed)
    return Pattern(
        np.column_stack([rng.uniform(0, WIDTH, blobs), rng.uniform(0, HEIGHT, blobs)]),
        rng.uniform(2.0, 6.0, (blobs, 2)),
        rng.uniform(0, np.pi, blobs),
        rng.choice([-1, 1], blobs) * rng.uniform(30, 80, blobs),
    )


def render(
    pattern: Pattern,
    angle_deg: float = 0.0,
    scale: float = 1.0,
    shift: tuple[float, float] = (0.0, 0.0),
    blur: float = 0.0,
) -> ImageArray:
    """The pattern turned (clockwise in the image) and scaled about the centre, moved, seen through a Gaussian blur."""
    grey = np.full((HEIGHT, WIDTH), 128.0)
    centres = moved(pattern.centres, angle_deg, scale, shift)
    for (cx, cy), sigmas, angle, height in zip(centres, pattern.sigmas, pattern.angles, pattern.heights, strict=True):
        seen = np.hypot(scale * sigmas, blur)
        fading = np.prod(scale * sigmas / seen)
        reach = 6 * seen.max()
        rows = slice(max(int(cy - reach), 0), max(int(cy + reach) + 1, 0))
        columns = slice(max(int(cx - reach), 0), max(int(cx + reach) + 1, 0))
        y, x = np.mgrid[:HEIGHT, :WIDTH][:, rows, columns].astype(np.float64)
        c, s = np.cos(angle + np.radians(angle_deg)), np.sin(angle + np.radians(angle_deg))
        u, v = c * (x - cx) + s * (y - cy), -s * (x - cx) + c * (y - cy)
        grey[rows, columns] += height * fading * np.exp(-0.5 * ((u / seen[0]) ** 2 + (v / seen[1]) ** 2))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def moved(
    xy: npt.NDArray[np.floating], angle_deg: float = 0.0, scale: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)
) -> npt.NDArray[np.float64]:
    """Where `render` puts the points `xy` [n, 2]."""
    cosine, sine = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return np.asarray(scale * (xy - CENTRE) @ np.array([[cosine, sine], [-sine, cosine]]) + CENTRE + shift)


@dataclass(frozen=True)
class Agreement:
    """How the keypoints of two views agree, over those of the first that lie well inside both."""

    compared: int
    repeated: float  # share with a keypoint of the same sign and size within 2 pixels in the other view
    place: float  # median distance of those, pixels
    turn: float  # median difference of their angles from the true turn, degrees
    matched: float  # share of the repeated whose nearest descriptor in the other view is that keypoint


def agreement(
    first: Features, second: Features, angle_deg: float = 0.0, scale: float = 1.0, border: float = 30.0
) -> Agreement:
    there = moved(first.xy.astype(np.float64), angle_deg, scale)
    low, high = np.array([border, border]), np.array([WIDTH, HEIGHT]) - 1 - border
    inside = ((there > low) & (there < high) & (first.xy > low) & (first.xy < high)).all(axis=1)
    inside &= (first.size * scale > 12) & (first.size * scale < 80)
    chosen = np.flatnonzero(inside)
    distance = np.linalg.norm(there[chosen, None] - second.xy[None], axis=2)
    size = np.abs(np.log2(first.size[chosen, None] * scale / second.size[None]))
    wrong = (size > 0.5) | (first.laplacian[chosen, None] != second.laplacian[None])
    distance[wrong] = np.inf
    nearest = distance.argmin(axis=1)
    best = distance[np.arange(len(chosen)), nearest]
    found = best < 2.0
    turned = first.angle[chosen] + angle_deg - second.angle[nearest]
    turned = np.abs((turned + 180) % 360 - 180)[found]
    similar = (first.descriptors[chosen] @ second.descriptors.T).argmax(axis=1)
    off = np.linalg.norm(second.xy[similar] - there[chosen], axis=1)[found]
    return Agreement(
        len(chosen),
        float(found.mean()),
        float(np.median(best[found])),
        float(np.median(turned)),
        float((off < 3).mean()),
    )
