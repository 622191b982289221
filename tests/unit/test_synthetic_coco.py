from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.recordings.synthetic import SyntheticOptions
from semdb.recordings.synthetic.coco import MIN_PIXELS, write_synthetic_coco
from semdb.recordings.synthetic.writer import SyntheticSequence
from semdb.training.coco import load_coco, mask_of, read_picture

OPTIONS = SyntheticOptions(frames=2, width=96, height=72, room_seed=3, lap_frames=8)


def test_rendered_masks_are_exact(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    write_synthetic_coco(tmp_path, OPTIONS, 1, "val", lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]
    data = load_coco(tmp_path, "val")
    sequence = SyntheticSequence(OPTIONS)
    assert len(data.pictures) == 2
    for index, picture in enumerate(data.pictures):
        frame = sequence.render(index)
        np.testing.assert_array_equal(read_picture(picture), frame.rgb)
        labels, counts = np.unique(frame.labels, return_counts=True)
        shown = [label for label, n in zip(labels, counts, strict=True) if label > 0 and n >= MIN_PIXELS]
        assert len(picture.instances) == len(shown) > 2
        for label, instance in zip(shown, picture.instances, strict=True):
            mask = mask_of(instance, picture)
            np.testing.assert_array_equal(mask, frame.labels == label)
            assert data.classes[instance.label] == sequence.classes[int(label)]
            v, u = np.nonzero(mask)
            assert instance.box == (u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1)
    with pytest.raises(UsageError, match="the split 'val' is there already"):
        write_synthetic_coco(tmp_path, OPTIONS, 1, "val")
