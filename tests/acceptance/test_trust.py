"""Verdicts on images that invite a wrong answer: a small part of `bench.trust`."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from bench.trust.asking import ask_world
from bench.trust.rows import Row
from bench.trust.suites import HARD, NEGATIVE, POSITIVE, RenderedSize, rendered_world
from semdb.evaluation.calibration import auroc
from semdb.settings import Settings

SIZE = RenderedSize(rooms=1, offices=1, frames=24, stride=2, width=320, height=240, like=())


@pytest.fixture(scope="module")
def rows(tmp_path_factory: pytest.TempPathFactory) -> list[Row]:
    """Answers in a room and in an office of equal desks; pictures of 320 x 240 pixels."""
    world = rendered_world(tmp_path_factory.mktemp("trust"), lambda line: None, SIZE)
    settings = Settings(detector="recorded", encoder="gist", database_url="sqlite:///unused.sqlite3")
    return list(ask_world(world, settings, 1, 0, lambda line: None))


def of(rows: Sequence[Row], kind: str, words: str = "") -> list[Row]:
    return [row for row in rows if row.kind == kind and words in row.suite]


def test_images_of_the_room_are_found(rows: list[Row]) -> None:
    asked = of(rows, POSITIVE)
    assert len(asked) >= 6
    assert all(row.is_localized and row.is_right for row in asked)


@pytest.mark.parametrize("words", ["other room", "no place", "outside the map"])
def test_no_image_of_elsewhere_is_found(rows: list[Row], words: str) -> None:
    asked = of(rows, NEGATIVE, words)
    assert len(asked) >= 4
    assert [row.name for row in asked if row.is_localized] == []


@pytest.mark.parametrize("words", ["equal desks", "blur", "darkness", "hand"])
def test_no_hard_image_is_placed_wrongly(rows: list[Row], words: str) -> None:
    asked = of(rows, HARD, words)
    assert len(asked) >= 6
    assert [row.name for row in asked if row.is_false] == []


def test_doubt_costs_little(rows: list[Row]) -> None:
    found = [row for row in of(rows, HARD, "equal desks") if "close" not in row.suite]
    assert sum(row.is_localized for row in found) >= 0.7 * len(found)
    half_hidden = of(rows, HARD, "hand 1")
    assert sum(row.is_localized for row in half_hidden) >= 0.6 * len(half_hidden)


def test_confidence_tells_right_from_wrong(rows: list[Row]) -> None:
    area = auroc([row.confidence for row in rows], [row.is_right for row in rows])
    assert area is not None
    assert area >= 0.97
