"""Colours of things: what tells two cups apart that are of one size."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.landmarks.lift import LiftedKeyframe
from semdb.types import Float32Array, ImageArray

HUES, GREYS, LIGHTS = 12, 6, 2
LENGTH = HUES * LIGHTS + GREYS
COLOURED, DARK = 64, 40  # of 255: saturation, and value, from which on a pixel has a hue
LIGHT = 128


def colours_of(rgb: ImageArray, lifted: LiftedKeyframe) -> Float32Array:
    """A colour histogram of each sighting, float32 ``[sightings, LENGTH]``, of length one; zeros where it has no pixel.

    `rgb` ``[H, W, 3]`` of the size of the camera. Bins are hues, dark and light, and greys; square roots are taken, so
    that the scalar product of two is how far they are alike (Bhattacharyya).
    """
    half, rows, columns = lifted.step // 2, *lifted.grid_owner.shape
    cells = np.ascontiguousarray(rgb[half :: lifted.step, half :: lifted.step][:rows, :columns])
    hue, saturation, value = np.moveaxis(cv2.cvtColor(cells, cv2.COLOR_RGB2HSV), 2, 0).astype(np.int64)
    coloured = (saturation >= COLOURED) & (value >= DARK)
    hued = (hue * HUES // 180) % HUES * LIGHTS + (value >= LIGHT)
    bins = np.where(coloured, hued, HUES * LIGHTS + value * GREYS // 256)
    labels = len(lifted.points) + 1
    counts = np.bincount((lifted.grid_owner.astype(np.int64) * LENGTH + bins).ravel(), minlength=labels * LENGTH)
    found = np.sqrt(counts.reshape(labels, LENGTH)[1:].astype(np.float64))
    length = np.linalg.norm(found, axis=1, keepdims=True)
    return np.asarray(found / np.where(length > 0, length, 1), np.float32)


def mean_colours(colours: Float32Array) -> Float32Array:
    """Of one thing, from its sightings ``[k, LENGTH]``: float32 ``[LENGTH]`` of length one, or zeros."""
    total = np.rint(colours.astype(np.float64) * 1e6).astype(np.int64).sum(axis=0).astype(np.float64)
    length = float(np.linalg.norm(total))
    return np.asarray(total / length if length > 0 else total, np.float32)
