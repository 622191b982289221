"""Bringing recordings of one map into the frame of another: keyframes are localized there, and move if all fits."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.database.links import list_links
from semdb.database.moving import move
from semdb.database.planning import check_models
from semdb.database.pose_records import Link, LinkKind, LinkState, Move, MovedRecording, OperationKind, PoseSource
from semdb.database.pose_sources import recording_poses
from semdb.database.records import KeyframeHead, MapInfo, RecordingStatus
from semdb.database.store import Store
from semdb.errors import UsageError
from semdb.geometry import pose_distances, pose_error
from semdb.geometry.volumes import Volume, volume_of
from semdb.localization.images import localizer_on
from semdb.localization.index import IndexSource, MapIndex
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.stored_query import stored_queries
from semdb.refinement.align_report import AlignedKeyframe, AlignReport
from semdb.settings import Settings
from semdb.trajectory.edges import EdgeArrays, EdgeState
from semdb.trajectory.sessions import (
    Claim,
    Consensus,
    Placed,
    SessionOptions,
    StepNoise,
    agree,
    chain_links,
    convinces,
    looks_the_same,
    place,
    step_covariances,
)
from semdb.types import FloatArray, Localization, Verdict

LOAD = 50  # keyframes that are read at a time
PROVENANCE = "semdb align"
Progress = Callable[[str, int, int], None]


@dataclass(slots=True, eq=False)
class _Side:
    """Keyframes of recordings or of a map, by recording and frame."""

    heads: list[KeyframeHead]
    number: dict[int, int] = field(default_factory=dict)
    poses: FloatArray = field(default_factory=lambda: np.empty((0, 4, 4)))

    def __post_init__(self) -> None:
        self.heads.sort(key=lambda head: (head.recording, head.frame_index))
        self.number = {head.id: n for n, head in enumerate(self.heads)}
        self.poses = np.array([head.world_from_camera for head in self.heads]).reshape(-1, 4, 4)

    def links(self, links: Sequence[Link], noise: StepNoise) -> EdgeArrays:
        """Its steps, and those of `links` that count and have both ends here."""
        steps = chain_links(self.poses, step_covariances(self.poses, noise))
        own = [one for one in links if one.first in self.number and one.second in self.number]
        kept = [one for one in own if one.state is LinkState.ACCEPTED]
        if not kept:
            return steps
        return EdgeArrays(
            np.concatenate([steps.first, np.array([self.number[one.first] for one in kept], np.int32)]),
            np.concatenate([steps.second, np.array([self.number[one.second] for one in kept], np.int32)]),
            np.concatenate([steps.first_from_second, np.stack([one.first_from_second for one in kept])]),
            np.concatenate([steps.information, np.stack([one.information for one in kept])]),
            np.concatenate([steps.robust, np.array([one.kind is not LinkKind.ODOMETRY for one in kept], np.bool_)]),
        )


def align_recordings(
    store: Store,
    recordings: Sequence[RecordingStatus],
    target: MapInfo,
    *,
    name: str | None = None,
    joint: bool = False,
    dry_run: bool = False,
    settings: Settings | None = None,
    options: SessionOptions | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> AlignReport:
    """Finds where `recordings` of one map lie in `target`, and moves them there if that convinces, but for a `dry_run`.

    `name` is that of a single recording in the map; with `joint` the map's keyframes may move too. Raises UsageError
    for what cannot be, ProvenanceError for maps that other models made, DatabaseError where rows change meanwhile.
    """
    options = options or SessionOptions()
    names = _check(store, recordings, target, name)
    mine = _Side([h for one in recordings for h in store.keyframe_heads(one.map_id, one.recording_id)])
    counted = len(store.keyframe_ids(target.id))
    theirs = _Side(store.keyframe_heads(target.id, bad=store.left_out))
    answers = _localized(store, mine, target, settings, progress, say)
    claims = _claims(answers, mine, theirs)
    consensus = agree(claims, theirs.poses, mine.poses, step_covariances(mine.poses, options.drift), options)
    near, same = _near(store, mine, theirs, consensus, claims, options)
    reason = convinces(consensus, near, same, options)
    placed = None
    if not reason:
        links = list_links(store.engine, recordings[0].map_id, bad=store.left_out)
        map_links = list_links(store.engine, target.id, bad=store.left_out) if joint else []
        placed = place(
            consensus,
            theirs.poses,
            mine.poses,
            mine.links(links, _stiffness(store, recordings, options)),
            theirs.links(map_links, _stiffness(store, store.status(target.id), options)) if joint else None,
            options,
        )
    report = _report(recordings, target, consensus, (near, same), reason, mine, answers, placed)
    if placed is None:
        return report
    shift = [pose_error(a, b)[0] for a, b in zip(placed.map_poses, theirs.poses, strict=True)]
    report = replace(report, map_shift_m=max(shift, default=0.0))
    if dry_run:
        return report
    wanted = _move(recordings, names, target, mine, theirs, consensus, placed, report, counted if joint else None)
    return replace(report, operation=move(store.engine, wanted))


def _check(store: Store, recordings: Sequence[RecordingStatus], target: MapInfo, name: str | None) -> dict[int, str]:
    """The names that recordings will have, by id."""
    if not target.keyframes:
        raise UsageError(f"the map {target.name!r} holds no keyframe, so nothing can be found in it")
    if name is not None and len(recordings) > 1:
        raise UsageError(f"--name names one recording, but {len(recordings)} are to be moved")
    taken = {one.name for one in store.status(target.id)}
    names = {}
    for one in recordings:
        if one.map_id == target.id:
            raise UsageError(f"the recording {one.name!r} is in the map {target.name!r} already")
        if not one.keyframes:
            raise UsageError(f"the recording {one.name!r} holds no keyframe: ingest it first")
        names[one.recording_id] = one.name if name is None else name
        if names[one.recording_id] in taken:
            raise UsageError(
                f"the map {target.name!r} has a recording {names[one.recording_id]!r} already: give this one another "
                "name with --name"
            )
    check_models(store.map_models(target.id), store.map_models(recordings[0].map_id), f"the map {target.name!r}")
    return names


def _stiffness(store: Store, recordings: Sequence[RecordingStatus], options: SessionOptions) -> StepNoise:
    """How far their poses may be off from keyframe to keyframe."""
    sources = [recording_poses(store.engine, one.recording_id).source for one in recordings]
    return options.drift if PoseSource.ESTIMATED in sources else options.recorded


def _localized(
    store: Store,
    mine: _Side,
    target: MapInfo,
    settings: Settings | None,
    progress: Progress | None,
    say: Callable[[str], None] | None,
) -> dict[int, Localization]:
    """What localizing each keyframe in the map gives, by id."""
    source = IndexSource(MapIndex.open(store, target.id, say=say))
    # What recorded poses are off by is the graph's to find. Poses far from keyframes, which only a look at the image
    # makes sure of, turned a half of the red kitchen by .61 degrees against the other; .38 without.
    options = LocalizerOptions(recorded_errors=False, by_depth=None, views=None)
    localizer = localizer_on(source, store, target, options, settings=settings, say=say)
    models = store.map_models(target.id)
    found: dict[int, Localization] = {}
    for done, (keyframe, description) in enumerate(stored_queries(store, list(mine.number), models), 1):
        found[keyframe.id] = localizer.localize(description)
        if progress is not None:
            progress(f"localizing keyframes in {target.name}", done, len(mine.heads))
    return found


def _claims(answers: Mapping[int, Localization], mine: _Side, theirs: _Side) -> list[Claim]:
    claims = []
    for key, answer in answers.items():
        known = answer.world_from_camera is not None and answer.covariance is not None
        if answer.verdict is not Verdict.LOCALIZED or not known or answer.best_keyframe_id not in theirs.number:
            continue
        assert answer.world_from_camera is not None
        assert answer.covariance is not None
        anchor = theirs.number[answer.best_keyframe_id]
        claims.append(
            Claim(
                mine.number[key],
                anchor,
                answer.world_from_camera,
                answer.covariance,
                answer.inliers,
                answer.confidence,
                answer.evidence.get("likeness", 1.0),
            )
        )
    return claims


def _near(
    store: Store,
    mine: _Side,
    theirs: _Side,
    consensus: Consensus,
    claims: Sequence[Claim],
    options: SessionOptions,
) -> tuple[list[int], list[int]]:
    """Numbers of keyframes that should see the same as the nearest one of the map does, and of those that do."""
    if consensus.map_from_recording is None:
        return [], []
    pairs: list[tuple[int, int]] = []
    far: dict[int, float] = {}
    for number, pose in enumerate(mine.poses):
        distance = pose_distances(consensus.map_from_recording @ pose, theirs.poses)
        nearest = int(np.argmin(distance))
        if distance[nearest] < options.near:
            pairs.append((number, nearest))
            far[number] = float(distance[nearest])
    moved = consensus.map_from_recording @ mine.poses
    one = _volumes(store, mine, sorted({number for number, _ in pairs}), moved)
    two = _volumes(store, theirs, sorted({nearest for _, nearest in pairs}), theirs.poses)
    near = [
        number
        for number, nearest in pairs
        if number in one
        and nearest in two
        and min(one[number].share_of(two[nearest].points), two[nearest].share_of(one[number].points))
        >= options.near_view
    ]
    likeness = {claim.number: claim.likeness for claim in claims}
    agreeing = set(near) & set(consensus.agreeing)
    return near, [n for n in near if n in agreeing and looks_the_same(likeness[n], far[n], options)]


def _volumes(store: Store, side: _Side, numbers: Sequence[int], poses: FloatArray) -> dict[int, Volume]:
    found = {}
    for start in range(0, len(numbers), LOAD):
        keys = [side.heads[n].id for n in numbers[start : start + LOAD]]
        for known in store.load_keyframes(keys, descriptors=False, bad=store.left_out):
            number = side.number[known.id]
            points = known.keypoints
            found[number] = volume_of(known.camera, poses[number], points.features.xy, points.points)
    return found


def _report(
    recordings: Sequence[RecordingStatus],
    target: MapInfo,
    consensus: Consensus,
    near: tuple[Sequence[int], Sequence[int]],
    reason: str,
    mine: _Side,
    answers: Mapping[int, Localization],
    placed: Placed | None,
) -> AlignReport:
    agreeing = set(consensus.agreeing)
    keyframes = []
    for number, head in enumerate(mine.heads):
        answer = answers.get(head.id)
        verdict = "damaged" if answer is None else answer.verdict.value
        off = shift = bend = math.nan, math.nan
        if placed is not None and consensus.map_from_recording is not None:
            shift = pose_error(placed.poses[number], mine.poses[number])
            bend = pose_error(placed.poses[number], consensus.map_from_recording @ mine.poses[number])
            if answer is not None and answer.world_from_camera is not None:
                off = pose_error(answer.world_from_camera, placed.poses[number])
        inliers = 0 if answer is None else answer.inliers
        keyframes.append(
            AlignedKeyframe(
                head.id, head.recording, head.frame_index, verdict, number in agreeing, inliers, *off, *shift, *bend
            )
        )
    return AlignReport(
        recordings=tuple(one.name for one in recordings),
        from_map=recordings[0].map,
        map=target.name,
        reason=reason,
        localized=len(consensus.edges),
        agreeing=len(agreeing),
        rival=consensus.rival,
        near=len(near[0]),
        near_same=len(near[1]),
        map_from_recording=consensus.map_from_recording,
        keyframes=tuple(keyframes),
    )


def _move(
    recordings: Sequence[RecordingStatus],
    names: Mapping[int, str],
    target: MapInfo,
    mine: _Side,
    theirs: _Side,
    consensus: Consensus,
    placed: Placed,
    report: AlignReport,
    counted: int | None,
) -> Move:
    """`counted`: keyframes of the map, where these move too."""
    motion = consensus.map_from_recording
    assert motion is not None
    joint, sides = counted is not None, [(mine, placed.poses, placed.covariances)]
    if joint:
        sides.append((theirs, placed.map_poses, placed.map_covariances))
    before = {head.id: head.world_from_camera for side, _, _ in sides for head in side.heads}
    after = {head.id: poses[n] for side, poses, _ in sides for n, head in enumerate(side.heads)}
    spread = {head.id: found[n] for side, _, found in sides for n, head in enumerate(side.heads)}
    evidence = {
        "localized": report.localized,
        "agreeing": report.agreeing,
        "rival": report.rival,
        "near": report.near,
        "near_same": report.near_same,
        "joint": joint,
    }
    links = tuple(_links(consensus, mine, theirs))
    anchors = {} if joint else {link.first: theirs.poses[theirs.number[link.first]] for link in links}
    return Move(
        kind=OperationKind.ALIGN,
        map_id=target.id,
        before=before,
        after=after,
        recordings=tuple(
            MovedRecording(one.recording_id, one.map_id, names[one.recording_id], motion) for one in recordings
        ),
        links=links,
        covariances={key: value for key, value in spread.items() if np.isfinite(value).all() and value.any()},
        relied_on=anchors,
        counted=counted,
        parameters=evidence,
    )


def _links(consensus: Consensus, mine: _Side, theirs: _Side) -> list[Link]:
    """Each claim as a link from the map's keyframe to the recording's."""
    count = len(theirs.heads)
    return [
        Link(
            first=theirs.heads[edge.first].id,
            second=mine.heads[edge.second - count].id,
            kind=LinkKind.SESSION,
            first_from_second=edge.first_from_second,
            information=edge.information,
            inliers=edge.inliers,
            state=LinkState.ACCEPTED if edge.state is EdgeState.ACCEPTED else LinkState.CONTRADICTED,
            reason=edge.reason,
            provenance=PROVENANCE,
        )
        for edge in consensus.edges
    ]
