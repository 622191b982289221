"""Masks as a real detector gives them: what is missed and misnamed, how often, and that it is always the same."""

from __future__ import annotations

import numpy as np

from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.recordings.synthetic.mistakes import MISNAMED, TAKEN_FOR, make_mistakes, with_misnamed

CLASSES = {1: "couch", 2: "cup", 3: "potted plant", **dict.fromkeys(range(4, 40), "chair")}
ALL = np.arange(40, dtype=np.uint16).reshape(4, 10)


def test_shares_are_as_asked_for_and_frames_differ() -> None:
    frames = [make_mistakes(ALL, CLASSES, 0.3, 0.2, 5, frame) for frame in range(60)]
    chairs = np.stack(frames).reshape(60, 40)[:, 4:]
    assert abs((chairs == 0).mean() - 0.3) < 0.03
    assert abs((chairs >= MISNAMED).mean() - 0.2) < 0.03
    assert len({frame.tobytes() for frame in frames}) == 60
    assert (make_mistakes(ALL, CLASSES, 0.3, 0.2, 5, 7) == frames[7]).all()
    assert (make_mistakes(ALL, CLASSES, 0.0, 0.0, 5, 7) == ALL).all()
    assert (make_mistakes(ALL, CLASSES, 1.0, 0.0, 5, 7) == 0).all()


def test_what_is_misnamed_has_the_name_of_a_class_like_its_own() -> None:
    classes = with_misnamed(CLASSES)
    wrong = make_mistakes(ALL, CLASSES, 0.0, 1.0, 5, 0)
    assert classes[int(wrong[0, 1])] == "bed"
    assert classes[int(wrong[0, 2])] == "bowl"
    assert classes[int(wrong[0, 3])] == "potted plant"  # nothing looks like one
    assert wrong[0, 0] == 0
    assert all(name != other for name, other in TAKEN_FOR.items())


def test_a_sequence_makes_mistakes_and_nothing_else_changes() -> None:
    small = {"frames": 3, "width": 64, "height": 48}
    exact = SyntheticSequence(SyntheticOptions(**small))  # type: ignore[arg-type]
    wrong = SyntheticSequence(SyntheticOptions(**small, missed=0.4, confused=0.3))  # type: ignore[arg-type]
    a, b = exact.render(1), wrong.render(1)
    assert (a.rgb == b.rgb).all()
    assert (a.depth == b.depth).all()
    shown = {int(label) for label in np.unique(b.labels)}
    assert (b.labels != a.labels).any()
    assert shown <= {0, *wrong.classes}
    assert not set(exact.classes) - set(wrong.classes)
    there = (b.labels > 0) & (b.labels < MISNAMED)
    assert (a.labels[there] == b.labels[there]).all()
