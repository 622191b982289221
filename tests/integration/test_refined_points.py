"""Refined points on both servers: what is written, when it is used; order of ingest and server do not matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text

from semdb.cli.status import refinements_of
from semdb.database import point_rows
from semdb.database.codecs import encode_array
from semdb.database.left_out import LeftOut
from semdb.database.pose_errors import POSE_ERRORS, load_pose_errors, write_pose_errors
from semdb.database.records import KeyframePoints, KeyframeRecord, MapInfo
from semdb.database.refinements import POINTS
from semdb.database.store import Store, open_store
from semdb.errors import CodecError
from semdb.geometry import pose_from, so3_exp
from semdb.localization.coarse import MapChange
from semdb.localization.images import make_localizer
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.open_maps import OpenMaps
from semdb.refinement import error_step
from semdb.refinement.run import refine_map
from semdb.settings import Settings
from semdb.types import Description, FloatArray, Keypoints, PoseErrors
from tests.database_samples import MODELS, description, plan, record
from tests.unit.localization_scene import CAMERA, Scene

FRAMES = 6
CATEGORIES = ["chair", "cup", "tv"]


STEPS = ("classes", "points", "errors", "landmarks")


def pose_of(frame: float) -> FloatArray:
    return pose_from(so3_exp([0, 0.06 * (frame - 3), 0]), [0.25 * (frame - 3), 0.1 * (frame % 2), 0.0])


def described(scene: Scene, frame: float, hidden: float) -> tuple[Description, Keypoints]:
    """A view of the scene, a share of its keypoints without depth; and what is true."""
    truth = scene.keypoints(pose_of(frame))
    points = truth.points.copy()
    points[scene.random.random(len(points)) < hidden] = np.nan
    made = description(int(frame * 2), CATEGORIES, camera=CAMERA)
    return replace(made, keypoints=replace(truth, points=points)), truth


@pytest.fixture(scope="module")
def views() -> tuple[list[KeyframeRecord], list[Keypoints], Description]:
    """Keyframes of one scene, their true keypoints, and a query with its image between two of them."""
    scene = Scene(2, 250)
    made = [described(scene, frame, 0.4) for frame in range(FRAMES)]
    records = [replace(record(n, view), world_from_camera=pose_of(n)) for n, (view, _) in enumerate(made)]
    return records, [truth for _, truth in made], described(scene, 2.5, 1.0)[0]


def ingest(store: Store, name: str, records: Sequence[KeyframeRecord], order: Sequence[int]) -> tuple[MapInfo, int]:
    map_id = store.ensure_map(name)
    planned = store.plan_recording(map_id, plan("walk", range(FRAMES)), MODELS)
    for index in order:
        store.write_keyframe(planned.recording_id, records[index])
    return store.find_map(name), planned.recording_id


def by_frame(store: Store, info: MapInfo) -> dict[int, bytes]:
    listed = store.listed_keyframes(info.id)
    points = store.refined_points([item.id for item in listed])
    return {item.frame_index: points[item.id].tobytes() for item in listed if item.id in points}


def test_points_that_are_missing_are_found(store: Store, views: tuple[list[KeyframeRecord], ...]) -> None:
    records, truths, query = views
    info, _ = ingest(store, "room", records, range(FRAMES))
    told: list[tuple[str, int, int]] = []
    (result,) = refine_map(store, info, kinds=[POINTS], progress=lambda *at: told.append(at))
    assert (result.kind, result.rows, result.computed, result.current) == (POINTS, FRAMES, True, True)
    assert told[-1][1:] == (2 * FRAMES, 2 * FRAMES)
    errors = []
    for listed, truth in zip(store.listed_keyframes(info.id), truths, strict=True):
        found = store.refined_points([listed.id])[listed.id]
        assert found.shape == (len(truth), 4)
        measured = store.load_keyframes([listed.id])[0].keypoints.points
        missing = np.isnan(measured[:, 2]) & np.isfinite(found[:, 2])
        errors += np.linalg.norm(found[missing, :3] - truth.points[missing], axis=1).tolist()
        with store.engine.connect() as connection:
            row = connection.execute(
                text("SELECT count, fused, triangulated FROM refined_points WHERE keyframe_id = :id"), {"id": listed.id}
            ).one()
        assert tuple(row) == (len(truth), int((np.isfinite(found[:, 2]) & ~missing).sum()), int(missing.sum()))
    assert len(errors) > 200
    assert np.median(errors) < 0.005
    # one neighbour each: more of them bring points of their own where depth is missing
    one, own = LocalizerOptions(neighbours=1), LocalizerOptions(neighbours=1, refined_points=False)
    with_points = make_localizer(store, info, "sql", one).localize(query)
    without = make_localizer(store, info, "sql", own).localize(query)
    assert (with_points.refinements, without.refinements) == ({"points": "used"}, {"points": "off"})
    assert with_points.inliers > 1.2 * without.inliers


def test_a_map_without_any_depth_is_refined_more_carefully(store: Store) -> None:
    scene = Scene(2, 250)
    made = [described(scene, frame, 1.0) for frame in range(FRAMES)]
    info, _ = ingest(
        store,
        "blind",
        [replace(record(n, view), world_from_camera=pose_of(n)) for n, (view, _) in enumerate(made)],
        range(FRAMES),
    )
    refine_map(store, info, kinds=[POINTS])
    errors = []
    for listed, (_, truth) in zip(store.listed_keyframes(info.id), made, strict=True):
        found = store.refined_points([listed.id])[listed.id]
        known = np.isfinite(found[:, 2])
        errors += np.linalg.norm(found[known, :3] - truth.points[known], axis=1).tolist()
    assert len(errors) > 200
    assert np.median(errors) < 0.02
    answer = make_localizer(store, info, "sql").localize(described(scene, 2.5, 1.0)[0])
    assert answer.verdict == "localized"
    assert answer.world_from_camera is not None
    assert np.linalg.norm(answer.world_from_camera[:3, 3] - pose_of(2.5)[:3, 3]) < 0.02


def test_order_of_ingest_and_server_do_not_matter(
    store: Store, views: tuple[list[KeyframeRecord], ...], tmp_path: Path
) -> None:
    first, _ = ingest(store, "first", views[0], range(FRAMES))
    second, _ = ingest(store, "second", views[0], [4, 1, 5, 0, 3, 2])
    with open_store(f"sqlite:///{tmp_path / 'other.sqlite3'}", create=True) as other:
        third, _ = ingest(other, "third", views[0], [5, 3, 1, 4, 2, 0])
        found = []
        for where, info in ((store, first), (store, second), (other, third)):
            refine_map(where, info, kinds=[POINTS])
            found.append(by_frame(where, info))
    assert len(found[0]) == FRAMES
    assert found[0] == found[1] == found[2]


def test_stale_points_are_not_used(store: Store, views: tuple[list[KeyframeRecord], ...]) -> None:
    records, _, query = views
    info, recording_id = ingest(store, "room", records, range(FRAMES - 1))
    said: list[str] = []
    localizer = make_localizer(store, info, "sql", say=said.append)
    assert localizer.localize(query).refinements == {"points": "none"}
    assert said == []
    refine_map(store, info)
    localizer = make_localizer(store, info, "sql")
    before = localizer.localize(query)
    assert before.refinements == {"points": "used"}
    store.write_keyframe(recording_id, records[FRAMES - 1])
    after = localizer.localize(query)  # the one that is open notices, and so does a new one
    assert after.refinements == {"points": "stale"}
    assert after.inliers < before.inliers
    assert refinements_of(store.refinements()) == {info.id: dict.fromkeys(STEPS, "stale")}
    fresh = make_localizer(store, info, "sql", say=said.append)
    assert "not used: run semdb refine" in said[-1]
    assert fresh.localize(query).inliers == after.inliers
    refine_map(store, info)
    assert refinements_of(store.refinements()) == {info.id: dict.fromkeys(STEPS, "current")}
    ids, _ = store.poses(info.id)
    store.delete_keyframes(ids[:1])  # its row goes with it
    assert set(by_frame(store, info)) == set(range(1, FRAMES))
    assert make_localizer(store, info, "sql").localize(query).refinements == {"points": "stale"}
    (result,) = refine_map(store, info, kinds=[POINTS])
    assert (result.rows, result.computed) == (FRAMES - 1, True)
    assert make_localizer(store, info, "sql").localize(query).refinements == {"points": "used"}
    store.delete_map(info.id)
    with store.engine.connect() as connection:
        assert connection.execute(text("SELECT COUNT(*) FROM refined_points")).scalar_one() == 0


def test_errors_of_recorded_poses_are_measured(store: Store, views: tuple[list[KeyframeRecord], ...]) -> None:
    records, _, query = views
    random = np.random.default_rng(3)
    off = [replace(one, world_from_camera=one.world_from_camera.copy()) for one in records]
    for one in off:
        one.world_from_camera[:3, 3] += random.normal(size=3) * 0.02
    found = {}
    for name, rows in (("exact", records), ("off", off)):
        info, recording_id = ingest(store, name, rows, range(FRAMES))
        before = make_localizer(store, info, "sql").localize(query)
        (result,) = refine_map(store, info, kinds=[POSE_ERRORS])
        assert (result.rows, result.current) == (1, True)
        after = make_localizer(store, info, "sql").localize(query)
        np.testing.assert_array_equal(after.world_from_camera, before.world_from_camera)  # to the bit
        assert (after.verdict, after.confidence) == (before.verdict, before.confidence)
        errors = load_pose_errors(store.engine, info.id)[recording_id]
        assert errors.keyframes >= 4
        assert errors.position_freedom == 3.0 * errors.keyframes
        found[name] = errors, before.covariance, after.covariance
    assert found["exact"][0].position_m < 0.002
    assert 0.008 < found["off"][0].position_m < 0.06
    # what is known of a recording counts for more than what is usual
    (_, first, exact), (_, _, far) = found["exact"], found["off"]
    assert exact[0, 0] < first[0, 0] < far[0, 0]


def test_an_open_map_takes_errors_that_are_measured_later(
    store: Store, views: tuple[list[KeyframeRecord], ...]
) -> None:
    info, recording_id = ingest(store, "room", views[0], range(2))
    cache, (ids, _) = KeyframeCache(store, info.id), store.poses(info.id)
    assert [view.pose_errors for view in cache.views(ids)] == [None, None]
    errors = PoseErrors(0.01, 0.005, 90.0, 60.0, 12)
    write_pose_errors(store.engine, recording_id, errors)
    assert [view.pose_errors for view in cache.views(ids)] == [None, None]
    cache.forget(MapChange(added=frozenset([ids[-1] + 1])))
    assert [view.pose_errors for view in cache.views(ids)] == [errors, errors]


def test_a_map_that_is_open_to_queries_takes_errors_once_they_are_measured(
    store: Store, views: tuple[list[KeyframeRecord], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    info, recording_id = ingest(store, "room", views[0], range(2))
    monkeypatch.setattr(OpenMaps, "_describer", lambda *_: None)
    maps, (ids, _) = OpenMaps(store, Settings()), store.poses(info.id)
    (first,) = maps.asked("room", "sql")
    before = first.localizer.cache.views(ids)
    assert [view.pose_errors for view in before] == [None, None]
    for errors in (PoseErrors(0.01, 0.005, 90.0, 60.0, 12), PoseErrors(0.01, 0.005000001, 90.0, 60.0, 12)):
        write_pose_errors(store.engine, recording_id, errors)  # no keyframe has changed
        (asked,) = maps.asked("room", "sql")
        assert asked.localizer is first.localizer  # and the rest stays in memory
        after = asked.localizer.cache.views(ids)
        assert [view.pose_errors for view in after] == [errors, errors]
        assert after[0].view is before[0].view
        assert maps.asked("room", "sql") == [asked]


def test_errors_of_recorded_poses_do_not_depend_on_other_steps(
    store: Store, views: tuple[list[KeyframeRecord], ...]
) -> None:
    found = []
    for name, kinds in (("first", [POSE_ERRORS]), ("last", [POINTS, POSE_ERRORS])):
        info, recording_id = ingest(store, name, views[0], range(FRAMES))
        refine_map(store, info, kinds=kinds)
        found.append(load_pose_errors(store.engine, info.id)[recording_id])
    assert found[0] == found[1]


def test_keyframes_equally_near_come_in_the_order_asked_for(
    store: Store, views: tuple[list[KeyframeRecord], ...]
) -> None:
    records = [replace(one, world_from_camera=pose_of(0)) for one in views[0]]
    info, _ = ingest(store, "room", records, range(FRAMES))
    cache, (ids, _) = KeyframeCache(store, info.id), store.poses(info.id)
    assert cache.near(pose_of(0), 1.0, ids[:2])[0] == ids[2:]
    found, poses = cache.near(pose_of(0), 1.0, (ids[1],), 3, [ids[4], ids[1], ids[-1] + 1, ids[0], ids[3], ids[2]])
    assert found == [ids[4], ids[0], ids[3]]
    assert poses.shape == (3, 4, 4)


def test_few_or_damaged_keyframes_are_not_measured_at_ingest(
    store: Store, views: tuple[list[KeyframeRecord], ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    info, recording_id = ingest(store, "room", views[0], range(FRAMES))
    error_step.measure_recording(store, recording_id, changed=True)
    assert load_pose_errors(store.engine, info.id) == {}
    monkeypatch.setattr(error_step, "FIRST_LEAST", FRAMES)
    for changed in (False, False, True):  # the last time in place of the first
        error_step.measure_recording(store, recording_id, changed=changed)
    first = load_pose_errors(store.engine, info.id)
    assert first[recording_id].keyframes >= 4
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE pose_errors SET position_m = -1"))
    said: list[str] = []
    with pytest.raises(CodecError, match=r"pose_errors\.position_m"):
        load_pose_errors(store.engine, info.id)
    listening = Store(store.engine, said.append)
    assert make_localizer(listening, info, "sql").localize(views[2]).verdict == "localized"
    assert any("semdb refine --force" in line for line in said)


def test_rows_that_cannot_be_right_are_refused(store: Store, views: tuple[list[KeyframeRecord], ...]) -> None:
    info, _ = ingest(store, "room", views[0], range(2))
    refine_map(store, info, kinds=[POINTS])
    (first, second) = (item.id for item in store.listed_keyframes(info.id))
    short = KeyframePoints(first, np.zeros((3, 4), np.float32), 3, 0)
    with store.engine.begin() as connection:
        assert point_rows.replace_points(connection, info.id, [short]) == 1
    said: list[str] = []
    store.left_out = LeftOut(said.append)
    (view,) = KeyframeCache(store, info.id).views([first])
    assert view.view.looser is None  # what was measured
    assert len([line for line in said if "3 points for" in line]) == 1
    assert len(KeyframeCache(store, info.id).views([second])) == 1  # without a row it keeps what was measured
    with store.engine.begin() as connection:
        blob = encode_array(np.zeros((3, 2), np.float32))
        connection.execute(text("UPDATE refined_points SET data = :data"), {"data": blob})
    with pytest.raises(CodecError, match=r"refined_points\.data of keyframe \d+: float32 \[n, 4\] is expected"):
        store.refined_points([first])
