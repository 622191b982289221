"""Another feature is asked where that of the map does not convince, on images that the map holds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import semdb
from semdb.cli.doctor import Check, plain
from semdb.database.store import open_store
from semdb.errors import ModelError, UsageError
from semdb.geometry import pose_error
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.localization.alike import Alike, LearnedVerdictOptions
from semdb.localization.coarse import Batch, Proposal, Stage
from semdb.localization.confidence import Evidence
from semdb.localization.fallback import Fallback, FallbackOptions, asked_first, weigh_alone, weigh_fallback
from semdb.localization.images import fallback_of, make_localizer
from semdb.localization.localizer import Localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.pose import PoseEstimate
from semdb.localization.verdict import Judgement, VerdictOptions
from semdb.perception.describe import describer_from_specs
from semdb.perception.features import load_features
from semdb.recordings import open_recording
from semdb.settings import Settings
from semdb.types import Description, Features, ImageArray, Localization, ModelInfo, Tolerance, Verdict


@pytest.fixture(scope="module")
def url(room: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    made = f"sqlite:///{tmp_path_factory.mktemp('fallback') / 'semdb.sqlite3'}"
    settings = Settings(database_url=made, detector="recorded", encoder="gist", features="surf", threads=1)
    ingest_recordings([room], settings, IngestOptions(stride=3, map_name="room"))
    return made


def described(room: Path, index: int) -> tuple[Description, np.ndarray]:
    recording = open_recording(room)
    frame = recording.read(recording.entries[index])
    settings = Settings(threads=1)
    found = describer_from_specs("recorded", "gist", "surf", settings).describe(
        frame.image, None, frame.camera, frame.instances
    )
    assert frame.world_from_camera is not None
    return found, frame.world_from_camera


class Counting:
    """A feature that counts the images it sees."""

    def __init__(self) -> None:
        self.inner = load_features("sift", Settings(threads=1))
        self.seen = 0

    @property
    def info(self) -> ModelInfo:
        return self.inner.info

    def extract(self, grey: ImageArray, mask: np.ndarray | None = None) -> Features:
        self.seen += 1
        return self.inner.extract(grey, mask)


def localizer(url: str, counting: Counting, options: LocalizerOptions | None = None) -> Localizer:
    store = open_store(url)
    return make_localizer(store, store.find_map("room"), "sql", options, fallback=Fallback(counting))


def in_doubt(description: Description) -> Description:
    """The same with one keypoint in thirty: a pose, but no sure one."""
    keypoints = description.keypoints
    rows = np.arange(0, len(keypoints), 30)
    features = Features(*(getattr(keypoints.features, name)[rows] for name in Features.__slots__))
    return replace(
        description,
        keypoints=replace(
            keypoints, features=features, object_index=keypoints.object_index[rows], points=keypoints.points[rows]
        ),
    )


def test_it_is_asked_only_where_keypoints_do_not_convince(room: Path, url: str) -> None:
    description, true = described(room, 4)
    counting = Counting()
    asked = localizer(url, counting)
    plain = asked.localize(description)
    assert plain.verdict is Verdict.LOCALIZED
    assert counting.seen == 0
    alone = localizer(url, counting, LocalizerOptions(fallback=False, edges=None))
    assert alone.localize(in_doubt(description)).verdict is not Verdict.LOCALIZED
    assert counting.seen == 0
    found = asked.localize(in_doubt(description))
    assert found.verdict is Verdict.LOCALIZED
    assert "keypoints of sift agree" in found.reason
    assert found.evidence["fallback_metres"] < 0.05
    assert found.evidence["fallback_alike"] > 0.9
    assert found.evidence["fallback_alike_in_all"] > 0.8
    assert found.world_from_camera is not None
    metres, degrees = pose_error(found.world_from_camera, true)
    assert metres < 0.02
    assert degrees < 0.5
    assert found.inliers > 60
    assert found.query_xy is not None
    assert len(found.query_xy) > 20
    assert found.timing_ms["fallback"] > 0
    assert {c.keyframe_id for c in found.candidates} >= {found.best_keyframe_id}
    keyframes = counting.seen - 1
    assert keyframes >= 1
    again = asked.localize(in_doubt(description))
    assert counting.seen == keyframes + 2  # those of keyframes are kept
    np.testing.assert_array_equal(again.world_from_camera, found.world_from_camera)


def test_nothing_is_made_of_an_image_that_is_not_at_hand(room: Path, url: str) -> None:
    description, _ = described(room, 4)
    counting = Counting()
    found = localizer(url, counting).localize(replace(in_doubt(description), grey=None))
    assert found.verdict is not Verdict.LOCALIZED
    assert counting.seen == 0


def test_the_setting_names_it(room: Path, url: str) -> None:
    models = open_store(url).map_models(1)
    assert fallback_of(Settings(features_fallback="surf", threads=1), models) is None  # the map's own
    named = fallback_of(Settings(features_fallback="sift", threads=1), models)
    assert named is not None
    assert named.name == "sift"
    with pytest.raises(UsageError, match="no local feature 'swift'"):
        fallback_of(Settings(features_fallback="swift"), models)
    with pytest.raises(ModelError, match="no model file"):
        fallback_of(Settings(features_fallback="onnx:nowhere.onnx"), models)
    with semdb.open(url, features_fallback="onnx:nowhere.onnx") as db, pytest.raises(ModelError, match="no model file"):
        list(db.localize_recording(room, every=20))


def test_a_matcher_needs_learned_features(room: Path, url: str) -> None:
    with semdb.open(url, matcher="onnx:x.onnx") as db, pytest.raises(UsageError, match="described by surf"):
        list(db.localize_recording(room, every=20))


def test_keyframes_with_most_pairs_come_first(room: Path, url: str) -> None:
    store = open_store(url)
    cache = make_localizer(store, store.find_map("room"), "sql").cache
    views = cache.views(cache.poses()[0][:5])
    ids = [view.keyframe_id for view in views]
    assert asked_first(views, [5, 9, 0, 7]) == [[ids[1], ids[3], ids[0]], [ids[2], ids[4]]]
    assert asked_first(views[:2], ()) == [ids[:2]]


def test_both_features_have_to_be_sure_together(room: Path, url: str) -> None:
    description, _ = described(room, 4)
    asked = localizer(url, Counting())
    search = asked._search(description, None)
    asked.fine.ask(search, Batch(Stage.ALL, tuple(Proposal(i, 0.0, 0.0) for i in asked.cache.poses()[0][:3]), 3))
    settled = asked.fine.settle(search)
    judgement, evidence = settled.judgement, settled.evidence
    own = search.estimate
    assert evidence is not None
    assert own is not None
    moved = replace(own, world_from_camera=own.world_from_camera.copy())
    moved.world_from_camera[0, 3] += 0.2

    def weigh(
        before: PoseEstimate | None = own,
        own_evidence: Evidence | None = evidence,
        anew: Evidence = evidence,
        alike: Alike | None = Alike(0.9, 0.8),
        said: Judgement = judgement,
        accept: Tolerance | None = None,
    ) -> Judgement | None:
        options, bounds = FallbackOptions(), VerdictOptions()
        return weigh_fallback(before, own_evidence, own, anew, alike, said, options, bounds, accept)

    given = weigh()
    assert given is not None
    assert given.verdict is Verdict.LOCALIZED
    weak = weigh(said=replace(judgement, confidence=0.55))
    assert weak is not None
    assert weak.confidence == VerdictOptions().localized_confidence
    assert weigh(said=replace(judgement, confidence=0.45)) is None
    assert weigh(before=None) is None
    assert weigh(own_evidence=None) is None
    assert weigh(own_evidence=replace(evidence, first_inliers=15)) is None
    assert weigh(own_evidence=replace(evidence, rival=evidence.first_of_best)) is None
    assert weigh(anew=replace(evidence, rival=evidence.first_of_best)) is None
    assert weigh(alike=None) is None
    assert weigh(alike=Alike(0.8, 0.8)) is None  # shapes agree, what is on them does not
    assert weigh(alike=Alike(0.9, 0.5)) is None  # a thing is there, the rest is another place
    assert weigh(anew=replace(evidence, sigma_m=0.07)) is None
    assert weigh(anew=replace(evidence, inliers=19)) is None
    assert weigh(before=moved) is None
    assert weigh(before=moved, accept=Tolerance(0.3, 5.0)) is not None

    def alone(
        before: PoseEstimate | None = None,
        alike: Alike | None = Alike(0.9, 0.8),
        said: Judgement = judgement,
        first: int = 16,
        anew: Evidence = evidence,
    ) -> Judgement | None:
        theirs = replace(evidence, first_inliers=first)
        return weigh_alone(before, theirs, own, anew, alike, said, FallbackOptions())

    assert alone() == judgement
    assert alone(own) == judgement
    assert alone(moved) is None  # the own feature has another pose
    assert alone(moved, first=15) == judgement  # which says nothing
    assert alone(said=replace(judgement, verdict=Verdict.AMBIGUOUS)) is None
    assert alone(alike=None) is None
    assert alone(alike=Alike(0.9, 0.64)) is None
    assert alone(anew=replace(evidence, likeness=0.45)) is None


def test_learned_features_are_believed_where_the_query_looks_alike(room: Path, url: str) -> None:
    description, _ = described(room, 4)

    def asked(learned: LearnedVerdictOptions | None) -> Localization:
        return localizer(url, Counting(), LocalizerOptions(fallback=False, learned=learned)).localize(description)

    plain, found = asked(None), asked(LearnedVerdictOptions())
    assert "alike" not in plain.evidence
    assert found.verdict is plain.verdict is Verdict.LOCALIZED
    np.testing.assert_array_equal(found.world_from_camera, plain.world_from_camera)
    assert found.confidence == plain.confidence
    assert found.evidence["alike"] > 0.95
    assert found.evidence["alike_in_all"] > 0.85
    unlike = asked(LearnedVerdictOptions(least_about=1.01))
    assert unlike.verdict is Verdict.AMBIGUOUS
    assert unlike.confidence <= 0.5
    assert "of what is about the pairs looks alike, " in unlike.reason


def test_doctor_says_where_it_would_help(url: str, tmp_path: Path, room: Path) -> None:
    made = f"sqlite:///{tmp_path / 'few.sqlite3'}"
    settings = Settings(
        database_url=made, detector="recorded", encoder="gist", features="orb", threads=1, max_keypoints=50
    )
    ingest_recordings([room], settings, IngestOptions(stride=6, map_name="few"))

    def said(url: str, settings: Settings) -> list[Check]:
        with open_store(url) as store:
            return list(plain(store.engine, settings))

    [found] = said(made, Settings())
    assert (found.state, found.what) == ("info", "map few")
    assert "have 48 keypoints in the mean, as of plain things" in found.text
    assert "SEMDB_FEATURES_FALLBACK=onnx:FILE" in found.text
    assert said(made, Settings(features_fallback="sift")) == []
    assert said(url, Settings()) == []
