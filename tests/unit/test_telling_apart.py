"""What becomes of an answer where poses are told apart by what keyframes predict: of one pose alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import pytest

from semdb.localization.coarse import Proposal
from semdb.localization.fine_step import FineStep
from semdb.localization.laid_pose import LaidPose
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.pose import estimate_pose, match_views
from semdb.localization.predicted_view import PlacedView, SmallView, Windows, small_view
from semdb.localization.search import Search, evidence_of
from semdb.localization.telling_apart import tell_apart
from semdb.localization.verdict import Judgement
from semdb.localization.view_step import Seen, Standing, ViewOptions
from semdb.localization.viewing import Viewing
from semdb.localization.views import ClassNumbers
from semdb.types import Camera, ConsistentPose, Description, FloatArray, Tolerance, Verdict
from tests.unit.localization_scene import Scene

SMALL = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
GREY = np.random.default_rng(0).integers(0, 255, (120, 160)).astype(np.uint8)
WEAK = Judgement(Verdict.LOCALIZED, 0.97, "30 keypoints agree")


def shifted(x: float) -> FloatArray:
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


def seen(pose: FloatArray, alike: float = 1.0) -> Seen:
    likeness = np.where(np.arange(12_000) < 12_000 * alike, 1.0, 0.0).reshape(100, 120).astype(np.float32)
    return Seen(pose, Windows(likeness, np.ones((100, 120), np.bool_), 1.0))


@dataclass(frozen=True)
class Told(Viewing):
    """One that is told how poses stand."""

    told: Standing | None = None
    lies: LaidPose | None = None
    alike: float = 1.0

    def laid(self, *_: object) -> LaidPose | None:
        return self.lies

    def of(self, description: Description) -> SmallView | None:
        return small_view(SMALL, GREY)

    def standing(self, search: Search, query: SmallView, description: Description) -> Standing | None:
        return self.told

    def see(self, query: SmallView, pose: FloatArray) -> Seen:
        return seen(pose, self.alike)


class NoNeighbours:
    def near(self, *_: object) -> tuple[list[int], FloatArray]:
        return [], np.zeros((0, 4, 4))

    def views(self, ids: Sequence[int], descriptors: object) -> list[object]:
        return []


def tell(
    points: int,
    standing: Standing,
    accept: Tolerance | None = None,
    lies: LaidPose | None = None,
    aside: float = 5.0,
    alike: float = 1.0,
    before: Judgement = WEAK,
    rivals: Sequence[ConsistentPose] = (),
) -> tuple[Search, Judgement]:
    """A query at the origin, whose keypoints were taken for a pose 5 m aside by a weak answer.

    `alike` is how the query looks like what is predicted at any other pose than those that stand.
    """
    scene, numbers = Scene(3, points), ClassNumbers()
    query, keyframes = scene.query(np.eye(4), numbers), [scene.keyframe(1, scene.pose(0.1, 2), numbers)]
    options = LocalizerOptions(neighbours=0)
    search = Search(query, 1, options.pose, accept, keyframes=list(keyframes), proposals=[Proposal(1, 1.0, 1.0)])
    search.matches = match_views(query, keyframes, options.pose)
    found = estimate_pose(query, keyframes, search.matches, options.pose)
    assert found is not None
    search.estimate = replace(found, world_from_camera=shifted(aside))
    search.others += rivals
    evidence = replace(evidence_of(search, found, 0), agreement=0.3, first_of_best=10, likeness=0.5)
    fine = FineStep(cast(Any, NoNeighbours()), (), options)
    viewing = Told(cast(Any, None), ViewOptions(), standing, lies, alike)
    judgement, _ = tell_apart(fine, viewing, search, cast(Any, None), before, evidence)
    return search, judgement


def test_a_sure_pose_has_the_verdict_of_its_own_keypoints() -> None:
    search, found = tell(300, Standing(seen(np.eye(4)), ()))
    assert search.estimate is not None
    assert np.abs(search.estimate.world_from_camera[:3, 3]).max() < 0.01
    assert found.verdict is Verdict.LOCALIZED
    search, found = tell(22, Standing(seen(np.eye(4)), ()))
    assert search.estimate is not None
    assert np.abs(search.estimate.world_from_camera[:3, 3]).max() < 0.1
    assert search.estimate.inliers < 20
    assert found.verdict is Verdict.AMBIGUOUS  # and not that of the pose 5 m aside
    assert "keypoints agree" in found.reason
    assert found.confidence != WEAK.confidence


def test_edges_hold_a_sure_pose_of_which_keypoints_are_few() -> None:
    lies = LaidPose(
        world_from_camera=shifted(0.001), covariance=np.eye(6) * 1e-6, support=9, others=(), doubts=(), fits_well=True,
        agrees="", better="", numbers={},
    )  # fmt: skip
    search, found = tell(22, Standing(seen(np.eye(4)), ()), lies=lies)
    assert search.estimate is not None
    assert search.estimate.inliers < 20
    assert np.abs(search.estimate.world_from_camera[:3, 3] - [0.001, 0, 0]).max() < 0.005
    assert found.verdict is Verdict.LOCALIZED
    assert search.seen is search.estimate.world_from_camera


@pytest.mark.parametrize(("alike", "verdict"), [(0.7, Verdict.AMBIGUOUS), (0.9, Verdict.LOCALIZED)])
def test_a_sure_pose_vouches_for_none_beside_it_that_does_not_look_so(alike: float, verdict: Verdict) -> None:
    """So much looks as predicted where keypoints agree, about the sure pose and 0.2 m aside."""
    doubt = Judgement(Verdict.AMBIGUOUS, 0.4, "a pose elsewhere has 18 against 20 inliers")
    rivals = [ConsistentPose(shifted(7.0), 18)]
    search, found = tell(300, Standing(seen(np.eye(4)), ()), aside=0.2, alike=alike, before=doubt, rivals=rivals)
    assert found.verdict is verdict
    if verdict is Verdict.AMBIGUOUS:
        assert found is doubt
        assert search.view_numbers["view_alike"] == pytest.approx(0.7, abs=0.01)
        assert len(search.others) == 1
    else:
        assert search.others == []


def test_a_pose_that_looks_as_much_like_the_image_is_named() -> None:
    search, found = tell(300, Standing(seen(shifted(5.0)), (seen(np.eye(4)),)))
    assert found.verdict is Verdict.AMBIGUOUS
    [other] = search.others
    assert other.world_from_camera[0, 3] == 0
    assert other.inliers > 100


@pytest.mark.parametrize(("metres", "same"), [(0.1, 0.25), (6.0, 6.0)])
def test_what_a_caller_accepts_is_one_pose(metres: float, same: float) -> None:
    assert ViewOptions().accepting(Tolerance(metres, 1.0)).same == Tolerance(same, 8.0)


class Places:
    """Of a map whose keyframes within a metre of the poses in `bare` have no depth."""

    def __init__(self, bare: Sequence[float]) -> None:
        self._bare = bare

    def views_seen_from(self, pose: FloatArray, query: SmallView, count: int) -> tuple[list[PlacedView], bool]:
        if any(abs(pose[0, 3] - x) < 1 for x in self._bare):
            return [], True
        depth = np.full(GREY.shape, 2.0, np.float32)
        return [PlacedView(1, pose, small_view(SMALL, GREY, depth))], False

    def edges_of(self, views: Sequence[PlacedView]) -> list[object]:
        return []

    def small_views(self, keyframes: Sequence[object]) -> list[PlacedView]:
        return []


def stood(bare: Sequence[float]) -> Standing | None:
    """How the pose that was found stands against one 5 m aside."""
    scene, numbers = Scene(3, 300), ClassNumbers()
    query, keyframes = scene.query(np.eye(4), numbers), [scene.keyframe(1, np.eye(4), numbers)]
    options = LocalizerOptions().pose
    search = Search(query, 1, options, None, [ConsistentPose(shifted(5.0), 50)], keyframes=keyframes)
    search.matches = match_views(query, keyframes, options)
    search.estimate = estimate_pose(query, keyframes, search.matches, options)
    viewing = Viewing(cast(Any, Places(bare)), ViewOptions())
    description = cast(Any, type("Image", (), {"grey": GREY, "camera": SMALL}))
    return viewing.standing(search, small_view(SMALL, GREY), description)


def test_a_pose_that_nothing_is_known_of_is_not_beaten() -> None:
    known = stood([])
    assert known is not None
    assert not known.is_sure(ViewOptions())  # both places look like the query
    half = stood([5.0])
    assert half is not None
    assert half.best.alike > 0.9
    assert half.unseen == 1
    assert not half.unbeaten
    assert not half.is_sure(ViewOptions())


def test_nothing_is_said_where_keyframes_have_no_depth() -> None:
    assert stood([0.0]) is None
    assert stood([0.0, 5.0]) is None
