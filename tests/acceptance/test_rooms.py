"""A map of several rooms with different furniture: the semantics leave little to rank, and more of it is right."""

from __future__ import annotations

import pytest

from bench.rooms import Row, compare, render
from semdb.recordings.synthetic import SyntheticOptions

ROOMS = 3


@pytest.fixture(scope="module")
def rows() -> dict[str, Row]:
    options = SyntheticOptions(frames=16, lap_frames=16, width=320, height=240, room_seed=100, noise=True)
    return {row.method: row for row in compare(render(options, ROOMS), "exact", ("cnn", "counts", "semdb"))}


def test_a_part_is_ranked_and_fewer_first_candidates_are_wrong(rows: dict[str, Row]) -> None:
    semantic, blind = rows["semdb"], rows["cnn"]
    assert (semantic.keyframes, semantic.queries) == (12 * ROOMS, 4 * ROOMS)
    assert blind.ranked == semantic.keyframes
    assert semantic.first_wrong < blind.first_wrong
    assert semantic.other_room < blind.other_room


def test_nothing_is_lost_and_nothing_is_false(rows: dict[str, Row]) -> None:
    assert rows["semdb"].localized >= rows["cnn"].localized
    assert all(row.false == 0 for row in rows.values())


def test_strengths_put_the_right_place_first_more_often_than_counts(rows: dict[str, Row]) -> None:
    assert rows["semdb"].first_wrong <= rows["counts"].first_wrong
