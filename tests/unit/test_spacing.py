"""How far keyframes are apart, and what `semdb doctor` says of it."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.geometry import so3_exp
from semdb.localization.spacing import spacing_of
from semdb.types import FloatArray


def turning(count: int, degrees: float, metres: float = 0.0) -> FloatArray:
    """Poses ``[count, 4, 4]`` that turn on while they move along a line."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for n in range(count):
        poses[n, :3, :3] = so3_exp(np.radians([0.0, n * degrees, 0.0]))
        poses[n, 0, 3] = n * metres
    return poses


@pytest.mark.parametrize("count", [4, 12, 500])
def test_it_is_that_of_the_nearest_keyframe(count: int) -> None:
    found = spacing_of(turning(count, 0.5, 0.06))
    assert found is not None
    assert (found.metres, found.degrees) == (pytest.approx(0.06), pytest.approx(0.5))
    assert found.distance == pytest.approx(0.06 / 0.3 + 0.5 / 15)
    assert not found.is_wide
    assert str(found) == "0.1 m and 0 deg"


def test_wide_is_more_than_45_degrees_or_90_centimetres() -> None:
    for wide, poses in ((False, turning(6, 44)), (True, turning(6, 46)), (True, turning(6, 1, 0.9))):
        found = spacing_of(poses)
        assert found is not None
        assert found.is_wide is wide


def test_so_few_keyframes_say_nothing() -> None:
    assert spacing_of(np.zeros((0, 4, 4))) is None
    assert spacing_of(turning(3, 90)) is None
    assert spacing_of(np.tile(np.eye(4), (4, 1, 1))) is not None  # all at one place
