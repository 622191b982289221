"""Several rooms in one world."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.recordings import open_recordings
from semdb.recordings.synthetic import SyntheticOptions, SyntheticSequence
from semdb.recordings.synthetic.writer import building, write_synthetic_building

SMALL = SyntheticOptions(frames=2, width=32, height=24)


def test_rooms_of_a_building_differ_and_lie_apart(tmp_path: Path) -> None:
    done: list[tuple[int, int]] = []
    folders = write_synthetic_building(tmp_path / "house", SMALL, 2, lambda *step: done.append(step))
    assert [folder.name for folder in folders] == ["room-000", "room-001"]
    assert done[-1] == (4, 4)
    recordings = [recording for folder in folders for recording in open_recordings(folder)]
    assert [recording.name for recording in recordings] == ["room-000", "room-001"]
    first, second = (np.stack([entry.world_from_camera for entry in r.entries]) for r in recordings)  # type: ignore[misc]
    assert abs(first[:, 0, 3]).max() < 5
    assert abs(second[:, 0, 3] - 20).max() < 5
    assert recordings[0].categories != recordings[1].categories
    with pytest.raises(UsageError, match="is not empty"):
        write_synthetic_building(tmp_path / "house", SMALL, 2)
    with pytest.raises(UsageError, match="at least one room"):
        building(SMALL, 0)


def test_a_place_moves_poses_and_nothing_else() -> None:
    here, there = (SyntheticSequence(SyntheticOptions(frames=2, width=32, height=24, place=k)) for k in (0, 3))
    a, b = here.render(1), there.render(1)
    assert (a.rgb == b.rgb).all()
    assert (a.depth == b.depth).all()
    np.testing.assert_allclose(
        b.world_from_camera - a.world_from_camera, np.diag([1, 0, 0, 0]) @ np.full((4, 4), [0, 0, 0, 60.0])
    )
