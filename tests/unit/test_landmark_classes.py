"""What things are, of all that the things of a map were called, and of how large they are."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.landmarks.evidence import Named, fuse, name_probabilities, named_as_one, settled
from semdb.landmarks.sizes import CARRIED, MOST, TYPICAL, sizes_of

CHAIR, BENCH, CUP, BOOK, PHONE = range(5)
NAMES = ("chair", "bench", "cup", "book", "cell phone")


def named(*counts: tuple[int, int]) -> Named:
    """A thing that was called each name so many times, with a score of 0.9."""
    category = np.repeat([name for name, _ in counts], [times for _, times in counts])
    return category.astype(np.int64), np.full(len(category), 0.9)


def test_the_rarer_class_needs_more() -> None:
    """Of 20 chairs six were called benches now and then: one that is a bench thrice and a chair twice is a chair."""
    things = [named((CHAIR, 4))] * 14 + [named((CHAIR, 3), (BENCH, 1))] * 6 + [named((BENCH, 3), (CHAIR, 2))]
    alone = fuse(*things[-1], name_probabilities(5, named_as_one(things, 5)))
    assert np.argmax(alone) == BENCH
    found = settled(things, np.zeros((len(things), 5)))
    assert np.argmax(found, axis=1).tolist() == [CHAIR] * len(things)
    assert found[-1, BENCH] > 0.02  # it may be one all the same
    benches = [named((BENCH, 4))] * 3
    assert np.argmax(settled([*things, *benches], np.zeros((24, 5)))[-3:], axis=1).tolist() == [BENCH] * 3


def test_in_any_order_it_is_the_same_to_the_last_bit() -> None:
    rng = np.random.default_rng(0)
    things = [named((CHAIR, int(a)), (BENCH, int(b)), (CUP, int(c))) for a, b, c in rng.integers(1, 5, (40, 3))]
    fits, order = rng.uniform(-MOST, 0, (40, 5)), rng.permutation(40)
    found = settled(things, fits)
    np.testing.assert_array_equal(settled([things[k] for k in order], fits[order]), found[order])
    assert found.sum(axis=1) == pytest.approx(1)
    assert settled([], np.zeros((0, 5))).shape == (0, 5)
    assert settled([named((0, 2))], np.zeros((1, 1))).tolist() == [[1]]  # of one class there is no other


def test_sizes_decide_between_names_and_nothing_else() -> None:
    large = sizes_of(NAMES).fits(np.array([[0.24, 0.03, 0.26]]))[0]
    assert large[[BOOK, PHONE]].tolist() == [0, -MOST]
    assert sizes_of(NAMES).fits(np.array([[0.08, 0.02, 0.05]]))[0, BOOK] > -1.5  # half of a book may be hidden
    mixed = [named((BOOK, 3), (PHONE, 1))] * 8
    things = [*mixed, named((PHONE, 2), (BOOK, 1)), named((PHONE, 1))]
    fits = np.tile(large, (len(things), 1))
    found = settled(things, fits)
    assert np.argmax(found, axis=1).tolist() == [BOOK] * len(things)
    either = [named((BOOK, 3), (PHONE, 3))]
    unknown = settled(either, np.array([[np.nan, np.nan, np.nan, -MOST, np.nan]]))
    assert unknown == pytest.approx(settled(either, np.zeros((1, 5))))  # nobody knows how large phones are
    alone = settled([named((CUP, 1))], np.array([[0.0, 0.0, -MOST, 0.0, 0.0]]))  # that nothing is taken for
    assert np.argmax(alone) == CUP
    assert alone == pytest.approx(settled([named((CUP, 1))], np.zeros((1, 5))))


def test_what_is_typical_is_in_order() -> None:
    for name, sides in TYPICAL.items():
        assert all(0 < low < high for low, high in sides), name
        assert [low for low, _ in sides] == sorted((low for low, _ in sides), reverse=True), name
        assert [high for _, high in sides] == sorted((high for _, high in sides), reverse=True), name
        middle = np.array([(low * high) ** 0.5 for low, high in sides])
        assert sizes_of([name]).fits(middle[None]).tolist() == [[0]]
    for name, (sides, longest) in CARRIED.items():
        assert 1.4 * sides[0][1] < longest < 4 * sides[0][1], name
    assert np.isnan(sizes_of(["of my own"]).fits(np.ones((2, 3)))).all()
