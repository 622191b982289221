"""A person walks before the camera while the room is recorded, and while it is asked for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semdb.database.store import open_store
from semdb.ingestion.run import ingest_recordings
from semdb.recordings import open_recording
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings
from tests.rooms import render, semdb

WALK = {"frames": 36, "width": 320, "height": 240, "lap_frames": 90}


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("walks")
    return {
        "empty": render(folder / "empty", SyntheticOptions(**WALK)),  # type: ignore[arg-type]
        "person": render(folder / "person", SyntheticOptions(person=True, **WALK)),  # type: ignore[arg-type]
    }


def evaluate(recording: Path, folder: Path, *options: str) -> dict[str, Any]:
    name = f"{recording.name}{'-'.join(options)}.json"
    done = semdb(
        *("evaluate", recording, "--keyframes", 9, "--max-queries", 20, "--json", folder / name, *options),
        url=f"sqlite:///{folder}/unused",
    )
    assert done.returncode == 0, done.stderr
    content = json.loads((folder / name).read_text())
    result: dict[str, Any] = content[0] if isinstance(content, list) else content
    return result


def test_the_person_covers_much_and_is_in_the_masks(walks: dict[str, Path]) -> None:
    recording = open_recording(walks["person"])
    assert recording.categories is not None
    shares = []
    for entry in recording.entries:
        frame = recording.read(entry)
        assert frame.instances is not None
        (label,) = [number for number, name in frame.instances.categories.items() if name == "person"]
        shares.append(np.mean(frame.instances.labels == label))
    assert min(shares) > 0.02
    assert 0.06 < np.mean(shares) < 0.3
    plain = open_recording(walks["empty"])
    first, other = plain.read(plain.entries[0]), recording.read(recording.entries[0])
    assert first.instances is not None
    assert other.instances is not None
    covered = other.instances.labels == label
    np.testing.assert_array_equal(first.image[~covered], other.image[~covered])
    assert first.depth is not None
    assert other.depth is not None
    assert (other.depth[covered] < first.depth[covered]).all()


def test_a_walking_person_does_not_hurt(walks: dict[str, Path], tmp_path: Path) -> None:
    empty = evaluate(walks["empty"], tmp_path)
    excluded = evaluate(walks["person"], tmp_path, "--dynamic", "person")
    included = evaluate(walks["person"], tmp_path)
    assert empty["queries"] == excluded["queries"] == 20
    assert excluded["success_rate"] >= empty["success_rate"] - 0.03
    assert excluded["false_localizations"] == 0
    # a tenth of the picture is hidden, and no more is lost
    assert excluded["median_translation_m"] < 1.7 * empty["median_translation_m"]
    assert excluded["median_translation_m"] < 1.1 * included["median_translation_m"]  # nor is it better to keep them


def test_no_keypoint_on_the_person_enters_the_map(walks: dict[str, Path], tmp_path: Path) -> None:
    settings = Settings(database_url=f"sqlite:///{tmp_path}/map.sqlite3", dynamic="person", threads=1)
    (summary,) = ingest_recordings([walks["person"]], settings)
    assert json.loads(summary.models[0].config)["dynamic"] == ["person"]
    recording = open_recording(walks["person"])
    by_index = {entry.index: entry for entry in recording.entries}
    seen = 0
    with open_store(settings.database_url) as store:
        map_id = store.maps()[0].id
        assert "person" not in {name for _, name, _ in store.category_counts(map_id)}
        for keyframe in store.load_keyframes(store.keyframe_ids(map_id)):
            frame = recording.read(by_index[keyframe.frame_index])
            assert frame.instances is not None
            (label,) = [number for number, name in frame.instances.categories.items() if name == "person"]
            person = (frame.instances.labels == label).astype(np.uint8)
            near = cv2.dilate(person, np.ones((5, 5), np.uint8)).astype(bool)
            xy = np.rint(keyframe.keypoints.features.xy).astype(int)
            assert not near[xy[:, 1], xy[:, 0]].any()
            seen += len(xy)
    assert seen > 3000
