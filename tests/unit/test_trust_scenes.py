"""Scenes of `bench.trust`: who is asked what, what counts as off, and which table of confidences comes of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bench.trust.rows import Row, report
from bench.trust.scenes import recorded_scene, scene_world
from bench.trust.suites import FIT, HARD, NEGATIVE, TEST
from semdb.errors import UsageError
from semdb.recordings import open_recording

ROW = Row("bare", "q", "bare3", TEST, "bare room, colour", HARD, "localized", 0.97, 0.01, 0.2, None, 5.0, "", {})


def test_a_recording_is_asked_all_its_frames_with_and_without_depth(room: Path) -> None:
    recording = open_recording(room)
    world = recorded_scene(recording, 1, 3)
    (plan,) = world.maps
    assert (plan.half, len(plan.entries)) == (TEST, 3)
    assert recorded_scene(recording, 2, 3).maps[0].half == FIT
    queries = list(world.queries())
    assert len(queries) == 2 * (len(recording.entries) - 3)
    colour, depth = queries[0].picture(), queries[1].picture()
    assert colour.depth is None
    assert depth.depth is not None
    assert depth.depth.shape == colour.image.shape[:2]
    assert [query.asked[0].suite for query in queries[:2]] == [f"{room.name}, colour", f"{room.name}, with depth"]


def test_what_is_no_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="bare, corridor, furnished, mirrored"):
        scene_world("kitchen3", tmp_path, lambda line: None)


def test_off_is_more_than_five_centimetres_or_degrees_and_every_other_place() -> None:
    assert not ROW.is_off
    assert replace(ROW, translation_m=0.06).is_off
    assert replace(ROW, rotation_deg=5.1).is_off
    assert not replace(ROW, translation_m=0.06, verdict="ambiguous").is_off
    assert replace(ROW, kind=NEGATIVE, translation_m=None).is_off


def test_the_report_says_how_often_a_confidence_is_right() -> None:
    wrong = replace(ROW, name="w", translation_m=0.3, confidence=0.85)
    foreign = replace(ROW, name="f", kind=NEGATIVE, translation_m=None, rotation_deg=None, verdict="failed")
    text = report([ROW, ROW, wrong, replace(foreign, confidence=0.0)])
    assert "0.82 to 0.90      0 of    1" in text
    assert "0.95 to 0.98      2 of    2" in text
    assert "bare: 1 of 3 localized are more than 5 cm or 5 degrees off or of another place (33.33%)" in text
