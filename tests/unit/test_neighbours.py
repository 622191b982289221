"""Which keyframe joins a pose."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.geometry import pose_distances, pose_from, so3_exp
from semdb.localization.neighbours import by_side, motions
from semdb.types import FloatArray


def at(x: float, y: float = 0.0, turn_deg: float = 0.0) -> FloatArray:
    return pose_from(so3_exp([0, np.radians(turn_deg), 0]), [x, y, 0])


def test_motions_are_in_the_units_of_pose_distances() -> None:
    pose = pose_from(so3_exp([0.4, -0.3, 1.0]), [1.0, -2.0, 0.5])
    others = np.stack([pose @ at(0.3), pose @ at(0.0, 0.6), pose @ at(0.0, 0.0, 30.0)])
    found = motions(pose, others)
    np.testing.assert_allclose(found[0], [1, 0, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found[1], [0, 2, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found[2], [0, 0, 0, 0, 2, 0], atol=1e-9)
    length = np.linalg.norm(found[:, :3], axis=1) + np.linalg.norm(found[:, 3:], axis=1)
    np.testing.assert_allclose(length, pose_distances(pose, others), atol=1e-9)


@pytest.mark.parametrize("frame", [np.eye(4), pose_from(so3_exp([0.4, -0.3, 1.0]), [1.0, -2.0, 0.5])])
def test_a_keyframe_on_the_other_side_comes_first(frame: FloatArray) -> None:
    pose, matched = frame, frame @ at(0.1)
    same, other, far = frame @ at(0.12), frame @ at(-0.15), frame @ at(-3.0)
    assert by_side(pose, matched, np.stack([same, other, far])) == [1, 0, 2]
    # turned as far to the other side as the matched one is to this
    assert by_side(pose, frame @ at(0, 0, 10), np.stack([frame @ at(0, 0, 8), frame @ at(0, 0, -12)])) == [1, 0]


def test_a_matched_keyframe_at_the_pose_leaves_the_nearest() -> None:
    assert by_side(at(0), at(0), np.stack([at(0.2), at(-0.1), at(0.0, 0.3)])) == [1, 0, 2]
    assert by_side(at(0), at(0.1), np.zeros((0, 4, 4))) == []
