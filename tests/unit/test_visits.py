"""What `bench.visits` makes of images: a telephone's picture, and which share of a view a keyframe sees."""

from __future__ import annotations

import numpy as np

from bench.trust.images import Picture
from bench.visits import Answer, as_by_phone, evenly, phone_camera
from semdb.geometry import pixels_to_normalized, project
from semdb.types import Camera, InstanceMasks


def test_a_telephone_sees_along_its_own_rays() -> None:
    camera = Camera(1200, 900, 744.0, 744.0, 599.5, 449.5)
    ramp = np.broadcast_to(np.linspace(40, 215, 1200).astype(np.uint8)[None, :, None], (900, 1200, 3)).copy()
    labels = (np.mgrid[:900, :1200][1] >= 600).astype(np.uint16)
    phone = phone_camera()
    seen = as_by_phone(Picture(ramp, camera, InstanceMasks(labels, {1: "right"})), phone)
    assert seen.image.shape == (720, 960, 3)
    assert seen.image.min() > 20  # nothing is outside of what was rendered
    pixels = np.array([[100.0, 100.0], [480.0, 360.0], [900.0, 650.0]])
    rays = pixels_to_normalized(phone, pixels)
    where = project(camera, np.column_stack([rays, np.ones(3)]))
    expected = 128 + 1.15 * (40 + where[:, 0] * 175 / 1199 - 122)
    shown = seen.image[pixels[:, 1].astype(int), pixels[:, 0].astype(int), 0]
    assert np.abs(shown - expected).max() < 4
    assert seen.instances is not None
    right = seen.instances.labels[pixels[:, 1].astype(int), pixels[:, 0].astype(int)]
    np.testing.assert_array_equal(right, where[:, 0] >= 599.5)


def test_entries_are_taken_evenly_and_answers_are_within_limits() -> None:
    assert evenly(list(range(10)), 4) == [0, 3, 6, 9]
    assert evenly([1, 2], 4) == [1, 2]
    answer = Answer("room", "another walk", 3, 0.8, "localized", 0.04, 6.0, 0.9, "")
    assert answer.is_localized
    assert not answer.within((0.05, 5.0))
    assert answer.within((0.05, 6.0))
