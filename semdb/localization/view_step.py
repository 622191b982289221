"""Poses that keypoints and edges cannot tell apart, told apart by what keyframes with depth predict from each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.localization.confidence import Evidence
from semdb.localization.edge_alignment import EdgeOptions
from semdb.localization.predicted_view import ALIKE, Windows
from semdb.localization.verdict import Judgement, VerdictOptions, is_precise
from semdb.localization.view_search import SearchOptions, is_same
from semdb.types import FloatArray, Tolerance, Verdict


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """When what is predicted decides. Windows are counted by their middles, pixels of the small image."""

    edges: EdgeOptions = field(default_factory=EdgeOptions)  # how poses that are compared are made better
    keyframes: int = 6  # of which a view is predicted
    most: int = 12  # poses that are looked at roughly,
    roughly: int = 2  # on so many keyframes,
    looked_at: int = 4  # and those of them that are compared, beside the pose that was found
    worth_laying: float = 0.5  # alike: these are made better by edges,
    worth_trusting: float = 0.65  # alike: where none is so much, others are looked for without keypoints
    search: SearchOptions = field(default_factory=SearchOptions)
    worth_seeing: float = 0.3  # roughly alike: these of them are looked at,
    layings: int = 4  # and made better by edges so often, while it helps
    same: Tolerance = field(default_factory=lambda: Tolerance(0.25, 8.0))  # poses nearer than this are one
    least_windows: int = 1500
    least_known: float = 0.1  # share of the image that is predicted
    least_alike: float = 0.88  # of what is predicted, to be sure: copies of a corridor turned round have up to .72
    least_lead: float = 0.04  # share of the windows that both predict, by which a pose is better than another
    lead_windows: int = 120
    far_less: float = 0.2  # alike: so much less is beaten, whatever both predict
    nearby: Tolerance = field(default_factory=lambda: Tolerance(0.6, 10.0))  # nothing is there twice so near
    weak_agreement: float = 0.45  # keypoints that convince by fewer pairs than these are looked at again,
    weak_first: int = 90
    plausible: float = 0.55  # alike: what convinces so and looks less as predicted does not; right ones of a cabinet .6
    more: int = 16  # keyframes that are matched besides
    least_inliers: int = 20
    least_support: int = 8  # where edges were laid besides
    confidence: float = 0.95  # of a pose that is sure

    def accepting(self, accept: Tolerance | None) -> ViewOptions:
        """The same for a caller who takes poses within `accept` for one."""
        if accept is None:
            return self
        return replace(
            self, same=Tolerance(max(self.same.metres, accept.metres), max(self.same.degrees, accept.degrees))
        )


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A pose with how the query looks like what is predicted from there."""

    world_from_camera: FloatArray
    windows: Windows

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.windows.compared))

    @property
    def alike(self) -> float:
        return self.windows.alike


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """The best of several poses by what is predicted; those elsewhere that look less like the query are beaten."""

    best: Seen
    unbeaten: tuple[Seen, ...]  # elsewhere, which may be right as well
    unseen: int = 0  # poses of which nothing is predicted, since keyframes there have no depth

    def is_sure(self, options: ViewOptions) -> bool:
        return not self.unbeaten and not self.unseen and is_like(self.best, options)

    def against(self, pose: FloatArray, options: ViewOptions) -> list[FloatArray]:
        """Poses ``[4, 4]`` that may be right as well as `pose`, or are better."""
        found = [seen.world_from_camera for seen in (self.best, *self.unbeaten)]
        return [other for other in found if not is_same(other, pose, options.same)]


def is_like(seen: Seen, options: ViewOptions) -> bool:
    """Whether the query looks like what is predicted, and enough is."""
    enough = seen.count >= options.least_windows and seen.windows.known >= options.least_known
    return enough and seen.alike >= options.least_alike


def beats(one: Seen, other: Seen, options: ViewOptions) -> bool:
    """Whether `one` looks clearly more like the query than `other`, where both predict something."""
    both = one.windows.compared & other.windows.compared
    first, second = one.windows.likeness[both] > ALIKE, other.windows.likeness[both] > ALIKE
    lead = np.count_nonzero(first & ~second) - np.count_nonzero(second & ~first)
    least = max(options.lead_windows, options.least_lead * len(first))
    nearby = is_same(one.world_from_camera, other.world_from_camera, options.nearby)
    return bool(lead >= least or other.alike < one.alike - (0.0 if nearby else options.far_less))


def stand(found: Sequence[Seen], options: ViewOptions) -> Standing:
    """The best of `found`, which is not empty."""
    enough = [seen for seen in found if seen.count >= options.least_windows] or list(found)
    best = max(enough, key=lambda seen: seen.alike)
    others = [seen for seen in found if not is_same(seen.world_from_camera, best.world_from_camera, options.same)]
    return Standing(best, tuple(seen for seen in others if not beats(best, seen, options)))


def is_weak(evidence: Evidence, options: ViewOptions) -> bool:
    """Whether keypoints that convince do so by so few that another place may have as many."""
    return evidence.agreement < options.weak_agreement and evidence.first_of_best < options.weak_first


def vouches(evidence: Evidence | None, least: int, bounds: VerdictOptions) -> bool:
    """Whether at least so many keypoints agree on a pose, and as exactly as a verdict needs."""
    return evidence is not None and evidence.inliers >= least and is_precise(evidence, bounds)


def judge_seen(
    judgement: Judgement,
    evidence: Evidence | None,
    standing: Standing,
    own: bool,
    options: ViewOptions,
    bounds: VerdictOptions,
    laid: bool = False,
) -> Judgement:
    """What becomes of a verdict of keypoints. `own`: the best pose is that of `evidence`; `laid`: by edges, too."""
    best = standing.best
    least = options.least_support if laid else options.least_inliers
    if own and evidence is not None and vouches(evidence, least, bounds) and standing.is_sure(options):
        reason = f"{best.alike:.0%} of the image look as the map predicts, {evidence.inliers} keypoints agree"
        return Judgement(Verdict.LOCALIZED, max(judgement.confidence, options.confidence), reason)
    if judgement.verdict is not Verdict.LOCALIZED:
        return judgement
    if own and best.count >= options.least_windows and best.alike < options.plausible:
        reason = f"only {best.alike:.0%} of the image look as the map predicts"
        return Judgement(Verdict.AMBIGUOUS, min(judgement.confidence, 0.5), reason)
    if own and not standing.unbeaten:
        return judgement
    return Judgement(Verdict.AMBIGUOUS, min(judgement.confidence, 0.5), "a pose elsewhere looks as much like the image")


def view_numbers(standing: Standing) -> dict[str, float]:
    """For the evidence of an answer."""
    best = standing.best
    return {
        "view_alike": best.alike,
        "view_known": best.windows.known,
        "view_rivals": float(len(standing.unbeaten) + standing.unseen),
    }
