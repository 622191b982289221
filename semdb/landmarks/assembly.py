"""Things of clusters of sightings: boxes, states, views, visits; each is remembered by all that it was made from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from semdb.landmarks.appearance import mean_colours
from semdb.landmarks.boxes import shared_volume
from semdb.landmarks.evidence import fuse
from semdb.landmarks.expected import expected_views
from semdb.landmarks.gravity import Gravity
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.links import sighting_table
from semdb.landmarks.memo import Memo, Noting, name_of
from semdb.landmarks.options import LandmarkOptions
from semdb.landmarks.remembered_thing import THING, Around, thing_arrays, thing_from
from semdb.landmarks.shape import thing_box, thing_points
from semdb.landmarks.values import BestView, Landmark, LandmarkState, Member
from semdb.landmarks.visibility import IN_VIEW, THROUGH, VISIBLE, Sightings, Views
from semdb.landmarks.visits import Presence, visits_of
from semdb.threads import cores, each
from semdb.types import Float32Array, FloatArray, Int64Array

EXPECTED = 0.5  # share of a thing's points in sight: the detector should have seen it
SEEN_THROUGH = 0.6  # share of a thing's points that are looked through
MOST_VIEWS = 3
FULL_SIZE = 0.02  # of the image: a thing this large is large enough to be looked at
NO_TIME = np.iinfo(np.int64).min


@dataclass(frozen=True, slots=True, eq=False)
class SeenKeyframe:
    """A keyframe with what the detector called its objects, by ordinal, and when it was taken."""

    lifted: LiftedKeyframe
    category: Int64Array  # [objects] number of the class
    score: FloatArray  # [objects]
    recording: int  # number of the recording, in the order of the names
    time_ns: int | None = None  # of the clock on the wall, where the recording has such times
    colours: Float32Array | None = None  # [sightings, n] see `appearance`; None where its image is none


class Assembly:
    """Things of their sightings."""

    def __init__(
        self,
        keyframes: Sequence[SeenKeyframe],
        lifted: Sequence[LiftedKeyframe],
        sightings: Sightings,
        views: Views,
        cluster: Int64Array,
        names: FloatArray,
        gravity: Gravity,
        options: LandmarkOptions,
        memo: Memo,
    ) -> None:
        self._memo = memo
        self._keyframes, self._lifted, self._sightings = keyframes, lifted, sightings
        self._names, self._gravity, self._options = names, gravity, options
        order = np.argsort(cluster, kind="stable")
        roots, start = np.unique(cluster[order], return_index=True)
        ends = [*start[1:].tolist(), len(order)][: len(roots)]
        self._rows = {int(r): order[s:e] for r, s, e in zip(roots, start, ends, strict=True)}
        self._views, self._cluster = views, cluster
        self._recordings = [frame.recording for frame in keyframes]
        self._recording = np.array(self._recordings, np.int64)
        self._time = np.array([NO_TIME if frame.time_ns is None else frame.time_ns for frame in keyframes], np.int64)
        self._first_of = {number: k for k, number in reversed(list(enumerate(self._recordings)))}
        named = all(frame.key for frame in lifted)
        self._keys = np.array([frame.key for frame in lifted], "S32") if named else None
        self._first_view = np.searchsorted(views.sighting, np.arange(len(sightings) + 1))
        own = np.zeros(len(views.sighting), np.int64)  # visible points in a mask of the same thing
        offset, number = sighting_table(lifted, sightings)
        labelled = views.overlap_label > 0
        pair = views.overlap_pair[labelled]
        other = number[offset[views.keyframe[pair]] + views.overlap_label[labelled] - 1]
        same = (other >= 0) & (cluster[np.maximum(other, 0)] == cluster[views.sighting[pair]])
        np.add.at(own, pair[same], views.overlap[labelled][same, 0])
        self._own = own

    def all(self) -> list[Landmark]:
        """The landmark of each cluster; those that take up one place are made one.

        Of two clusters that no keyframe saw beside each other, under names that are taken for each other, the one
        whose box lies in the other's most comes first.
        """
        roots = sorted(self._rows)
        things = dict(zip(roots, each(self.landmark, roots, cores()), strict=True))
        while pairs := self._at_one_place(things):
            done: set[int] = set()
            for _, one, other in pairs:
                if one in done or other in done:
                    continue
                done |= {one, other}
                self._rows[one] = np.sort(np.concatenate([self._rows[one], self._rows.pop(other)]))
                del things[other]
                things[one] = self.landmark(one)
        return list(things.values())

    def _at_one_place(self, things: Mapping[int, Landmark]) -> list[tuple[int, int, int]]:
        """Pairs of clusters that are one thing: overlap (negative, thousandths), one, other; the surest first."""
        roots = sorted(things)
        if len(roots) < 2:
            return []
        centres = np.array([things[root].box.centre for root in roots])
        reach = np.array([float(np.linalg.norm(things[root].box.size)) for root in roots])
        found = []
        mixed = np.maximum(self._names, self._names.T)
        longest = np.array([float(things[root].box.size.max()) for root in roots])
        pairs = cKDTree(centres).query_pairs(float(reach.max()), output_type="ndarray")
        away = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
        pairs = pairs[away <= (longest[pairs[:, 0]] + longest[pairs[:, 1]]) / 2]
        for a, b in pairs.tolist():
            one, other = things[roots[min(a, b)]], things[roots[max(a, b)]]
            known = {member.keyframe for member in one.members}
            if any(member.keyframe in known for member in other.members):
                continue
            if one.category != other.category and mixed[one.category, other.category] <= 2 * float(self._names.min()):
                continue
            share = shared_volume(one.box, other.box) / float(min(np.prod(one.box.size), np.prod(other.box.size)))
            if share >= self._options.one_place:
                found.append((-round(share * 1000), roots[min(a, b)], roots[max(a, b)]))
        return sorted(found)

    def landmark(self, root: int) -> Landmark:
        """The landmark of the sightings of a cluster."""
        rows = self._rows[root]
        members = self._members(rows)
        objects = [(k, int(o)) for k, s in sorted(members.items()) for one in sorted(s) for o in self._ordinals(k, one)]
        objects.sort()
        category = np.array([self._keyframes[k].category[o] for k, o in objects], np.int64)
        score = np.array([self._keyframes[k].score[o] for k, o in objects], np.float64)
        evidence = fuse(category, score, self._names)
        best = int(np.argmax(np.round(evidence, 9)))
        around = self._around(rows, members)
        name = self._name(around, members, rows, score)
        found = None if name is None else self._memo.get(THING, name)
        if found is None:
            noting = Noting(self._memo)
            found = thing_arrays(self._computed(rows, members, objects, around, noting), around, noting.asked)
            if name is not None:
                self._memo.put(THING, name, found)
        else:
            for one in found["asked"].tolist():
                self._memo.keep(*one.decode().split(" "))
        return replace(
            thing_from(found, around, objects), category=best, probability=float(evidence[best]), evidence=evidence
        )

    def _around(self, rows: Int64Array, members: Mapping[int, Sequence[int]]) -> Around:
        """The keyframes that have to do with a thing: those that show it, and those that may have it in view."""
        views = [self._views.keyframe[self._first_view[r] : self._first_view[r + 1]] for r in rows.tolist()]
        candidates = np.unique(np.concatenate(views))
        keyframes = np.union1d(candidates, np.array(sorted(members), np.int64))
        recordings, recording = np.unique(self._recording[keyframes], return_inverse=True)
        return Around(keyframes, candidates, recordings, recording)

    def _name(
        self, around: Around, members: Mapping[int, Sequence[int]], rows: Int64Array, score: FloatArray
    ) -> str | None:
        """Of all that a thing is made from, but what its sightings are called; None where keyframes have no name."""
        if self._keys is None:
            return None
        rank = around.rank
        return name_of(
            self._options,
            self._gravity.up,
            self._keys[around.keyframes],
            around.recording,
            self._time[around.keyframes],
            self._time[[self._first_of[k] for k in around.recordings.tolist()]],
            rank(around.candidates),
            rank(np.array([k for k, numbers in sorted(members.items()) for _ in numbers], np.int64)),
            np.array([one for _, numbers in sorted(members.items()) for one in sorted(numbers)], np.int64),
            np.unique(self._cluster[rows], return_inverse=True)[1],  # several, where those at one place were made one
            score,
        )

    def _computed(
        self,
        rows: Int64Array,
        members: dict[int, list[int]],
        objects: Sequence[tuple[int, int]],
        around: Around,
        memo: Memo,
    ) -> Landmark:
        """A landmark, whatever it is called: nothing but what `_name` names goes into it."""
        options = self._options
        points = thing_points(self._lifted, members, options.shape, memo)
        box = thing_box(self._lifted, members, points, self._gravity.up, options.shape, memo)
        seen = self._seen(rows)
        shares = {
            k: (min(1.0, own / max(visible, 1)), min(1.0, visible / max(total, 1)))
            for k, (total, _, visible, _, own) in seen.items()
        }
        listed = tuple(Member(k, o, *map(_rounded, shares.get(k, (1.0, 1.0)))) for k, o in objects)
        missed, through = self._elsewhere(seen, members)
        times = sorted(members)
        visits = visits_of(
            self._lifted,
            self._recordings,
            members,
            around.candidates,
            (points, box),
            self._gravity.up,
            (options.shape, options.visit),
            memo,
        )
        after = [v for v in visits if self._is_later(self._first_of[v.recording], times[-1])]
        gone = any(visit.presence is Presence.ABSENT for visit in after)
        gone &= all(visit.presence is not Presence.PRESENT for visit in after)
        return Landmark(
            members=listed,
            category=-1,
            probability=0.0,
            evidence=np.empty(0),
            box=box,
            covariance=self._covariance(rows, box.size),
            keyframes=len(members),
            missed=len(missed),
            seen_through=len(through),
            first=times[0],
            last=times[-1],
            state=LandmarkState.GONE if gone else self._state(len(members), len(missed), through, times[-1]),
            views=self._best_views(listed, box.centre),
            colours=self._colours(rows),
            visits=visits,
            expected=expected_views(self._lifted, points, {k: shares[k][1] for k in missed}),
        )

    def _members(self, rows: Int64Array) -> dict[int, list[int]]:
        """Numbers of sightings by keyframe."""
        members: dict[int, list[int]] = {}
        for row in rows.tolist():
            members.setdefault(int(self._sightings.keyframe[row]), []).append(int(self._sightings.label[row]) - 1)
        return members

    def _ordinals(self, keyframe: int, sighting: int) -> Int64Array:
        """Of the objects that are one sighting."""
        return np.flatnonzero(self._lifted[keyframe].sighting_of == sighting)

    def _seen(self, rows: Int64Array) -> dict[int, tuple[int, int, int, int, int]]:
        """Of each keyframe: points looked up, in view, visible, seen through, and in a mask of the thing.

        A sighting says nothing of its own keyframe, unless it is the only one.
        """
        views, sightings = self._views, self._sightings
        start, stop = self._first_view[rows], self._first_view[rows + 1]
        row = np.repeat(rows, stop - start)
        at = np.concatenate([np.arange(a, b) for a, b in zip(start.tolist(), stop.tolist(), strict=True)])
        others = (views.keyframe[at] != sightings.keyframe[row]) | (len(rows) == 1)
        row, at = row[others], at[others]
        keyframes, place = np.unique(views.keyframe[at], return_inverse=True)
        seen = views.seen[at]
        values = (sightings.count[row], seen[:, IN_VIEW], seen[:, VISIBLE], seen[:, THROUGH], self._own[at])
        sums = np.zeros((len(keyframes), len(values)), np.int64)
        np.add.at(sums, place, np.stack(values, axis=1))
        return {k: (a, b, c, d, e) for k, (a, b, c, d, e) in zip(keyframes.tolist(), sums.tolist(), strict=True)}

    def _elsewhere(
        self, seen: dict[int, tuple[int, int, int, int, int]], members: dict[int, list[int]]
    ) -> tuple[list[int], list[int]]:
        """Keyframes that should show the thing and do not, and those that see through its place."""
        missed, through = [], []
        for keyframe, (total, in_view, visible, seen_through, _) in sorted(seen.items()):
            if keyframe in members:
                continue
            if visible >= EXPECTED * total:
                missed.append(keyframe)
            elif in_view >= EXPECTED * total and seen_through >= SEEN_THROUGH * max(in_view, 1):
                through.append(keyframe)
        return missed, through

    def _state(self, keyframes: int, missed: int, through: Sequence[int], last: int) -> LandmarkState:
        options = self._options
        later = [k for k in through if self._is_later(k, last)]
        if len(later) >= options.gone:
            return LandmarkState.GONE
        if keyframes >= options.least(keyframes, missed):
            return LandmarkState.CONFIRMED
        return LandmarkState.TENTATIVE

    def _is_later(self, keyframe: int, other: int) -> bool:
        """Whether a keyframe is known to be later than another one."""
        one, two = self._keyframes[keyframe], self._keyframes[other]
        if one.recording == two.recording:
            return keyframe > other
        return one.time_ns is not None and two.time_ns is not None and one.time_ns > two.time_ns

    def _covariance(self, rows: Int64Array, size: FloatArray) -> FloatArray:
        """Of the box's centre: how the middles of the sightings scatter, and what a pose is good for."""
        count = len(rows)
        centres = np.array([self._sightings.points[r, : self._sightings.count[r]].mean(axis=0) for r in rows])
        noise = np.eye(3) * self._options.register.position_sigma_m**2
        least = np.diag((0.02 * size) ** 2) + noise / 4
        if count < 3:
            return np.asarray(np.eye(3) * (0.1 * float(size.max())) ** 2 + noise, np.float64)
        apart = centres - centres.mean(axis=0)
        return np.asarray((apart.T @ apart / (count - 1) + noise) / count + least, np.float64)

    def _colours(self, rows: Int64Array) -> Float32Array | None:
        """The mean of what its sightings look like; None where no image is known."""
        found = []
        for row in rows.tolist():
            colours = self._keyframes[int(self._sightings.keyframe[row])].colours
            if colours is not None:
                found.append(colours[int(self._sightings.label[row]) - 1])
        return mean_colours(np.array(found)) if found else None

    def _best_views(self, members: Sequence[Member], centre: FloatArray) -> tuple[BestView, ...]:
        found: dict[int, BestView] = {}
        for member in members:
            frame, lifted = self._keyframes[member.keyframe], self._lifted[member.keyframe]
            sighting = int(lifted.sighting_of[member.ordinal])
            size = lifted.areas[sighting] / (lifted.camera.width * lifted.camera.height)
            quality = member.visibility * min(1.0, size / FULL_SIZE) ** 0.5 * (0.5 if lifted.cut[sighting] else 1.0)
            quality *= 0.5 + 0.5 * float(frame.score[member.ordinal])
            distance = float(np.linalg.norm(centre - lifted.world_from_camera[:3, 3]))
            view = BestView(member.keyframe, member.ordinal, _rounded(quality), _rounded(distance))
            known = found.get(member.keyframe)
            if known is None or view.quality > known.quality:
                found[member.keyframe] = view
        return tuple(sorted(found.values(), key=lambda v: (-v.quality, v.keyframe, v.ordinal))[:MOST_VIEWS])


def _rounded(value: float) -> float:
    return round(float(value), 6)
