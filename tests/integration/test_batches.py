"""Keyframes that go through the networks at once: the rows of one by one, and a bad frame costs only itself."""

from __future__ import annotations

import dataclasses
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.cli.options import Overrides, load_settings
from semdb.database import items
from semdb.database.store import Store, open_store
from semdb.errors import ModelError, UsageError
from semdb.ingestion.queue import Workplace, queue_recordings
from semdb.ingestion.run import IngestOptions, ingest_recording, ingest_recordings, plan_ingest
from semdb.ingestion.work import work_off
from semdb.perception.describe import Describer
from semdb.perception.encoders import load_encoder
from semdb.perception.features import load_features
from semdb.recordings import open_recordings
from semdb.recordings.base import FrameEntry, Recording
from semdb.settings import Settings
from semdb.types import Detection, Frame, ImageArray, ModelInfo
from tests.integration.comparison import content
from tests.integration.test_queue import Outbox

STRIDE, KEYFRAMES = 3, (0, 3, 6, 9, 12, 15, 18, 21)
OPTIONS = IngestOptions(stride=STRIDE, map_name="m")


class Bright:
    """Finds what is bright, in any number of images; notes how many it was given, and fails where `fails` says so."""

    info = ModelInfo("detector", "bright", "")
    classes = ("bright",)
    best_batch = 3

    def __init__(self, fails: Callable[[Sequence[ImageArray]], bool] = lambda images: False) -> None:
        self.given: list[int] = []
        self._fails = fails

    def detect(self, image: ImageArray, instances: object = None) -> tuple[Detection, ...]:
        return self.detect_batch([image])[0]

    def detect_batch(self, images: Sequence[ImageArray]) -> list[tuple[Detection, ...]]:
        self.given.append(len(images))
        if self._fails(images):
            raise ModelError("bright: does not see")
        box = np.array([0, 0, 9, 9], np.float32)
        masks = [image.mean(axis=2) > image.mean() for image in images]
        return [(Detection("bright", float(mask.mean()), box, mask),) for mask in masks]


def describer(batch: int | None = None, detector: Any = None) -> Describer:
    found = detector or Bright()
    return Describer(found, load_encoder("gist", Settings()), load_features("orb", Settings()), batch=batch)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with open_store(f"sqlite:///{tmp_path / 'a.sqlite3'}", create=True) as opened:
        yield opened


@pytest.fixture(scope="module")
def expected(room: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[Any, ...]]]:
    """What one by one stores."""
    with open_store(f"sqlite:///{tmp_path_factory.mktemp('one') / 'a.sqlite3'}", create=True) as store:
        ingest(room, store, describer(1))
        return content(store)


def ingest(room: Path, store: Store, *describers: Describer) -> Any:
    [recording] = open_recordings(room)
    return ingest_recording(recording, store, describers, OPTIONS)


@pytest.mark.parametrize(
    ("batch", "threads", "given"),
    [(1, 1, [1] * 8), (2, 1, [2] * 4), (3, 1, [3, 3, 2]), (None, 1, [3, 3, 2]), (5, 2, [5, 3]), (64, 1, [8])],
)
def test_batches_make_the_rows_of_one_by_one(
    room: Path, store: Store, expected: Any, batch: int | None, threads: int, given: list[int]
) -> None:
    seen = Bright()
    summary = ingest(room, store, *(describer(batch, seen) for _ in range(threads)))
    assert (summary.stored, summary.failed) == (8, {})
    assert sorted(seen.given) == sorted(given)
    assert content(store) == expected
    assert summary.seconds["detect"] > 0


def test_results_keep_their_order_and_a_batch_is_not_waited_for(room: Path, store: Store) -> None:
    """What was claimed before may have ended its worker: it goes alone, and takes nobody along the next time."""
    [recording] = open_recordings(room)
    made = [describer(3, seen) for seen in [Bright()] for _ in range(2)]
    summary, _ = plan_ingest(recording, store, made[0].models, OPTIONS)
    items.claim(store.engine, summary.recording_id, "died", limit=1, frames=[9])
    items.release(store.engine, summary.recording_id, "died")
    done = list(work_off(recording, summary.recording_id, store, made))
    assert tuple(item.claim.frame_index for item in done) == KEYFRAMES
    assert sorted(made[0].detector.given) == [1, 2, 2, 3]  # type: ignore[attr-defined]


def test_told_to_stop_it_finishes_the_batches_that_are_under_way(room: Path, store: Store) -> None:
    [recording] = open_recordings(room)
    one = describer(3)
    summary, _ = plan_ingest(recording, store, one.models, IngestOptions(stride=1, map_name="m"))
    done: list[int] = []
    for item in work_off(recording, summary.recording_id, store, [one], stop=lambda: bool(done)):
        done.append(item.claim.frame_index)
    assert done == list(range(len(done)))
    assert 3 <= len(done) <= 12
    assert len(done) % 3 == 0
    assert items.left(store.engine, summary.recording_id) == (24 - len(done), 0)


@pytest.mark.parametrize("position", range(3))
def test_a_corrupt_frame_in_each_position_of_a_batch(
    room: Path, store: Store, expected: Any, tmp_path: Path, position: int
) -> None:
    copy = tmp_path / "room"
    shutil.copytree(room, copy)
    broken = sorted((copy / "rgb").iterdir())[KEYFRAMES[position]]
    data = bytearray(broken.read_bytes())
    data[len(data) // 2] ^= 0xFF  # header and end are whole
    broken.write_bytes(data)
    seen = Bright()
    summary = ingest(copy, store, describer(3, seen))
    assert list(summary.failed) == [KEYFRAMES[position]]
    assert broken.name in summary.failed[KEYFRAMES[position]]
    assert seen.given == [2, 3, 2]
    assert content(store)["frames"] == [row for row in expected["frames"] if row[0] != KEYFRAMES[position]]


def pixels(room: Path, frame: int) -> ImageArray:
    [recording] = open_recordings(room)
    return recording.read(recording.entries[frame]).image


@pytest.mark.parametrize("position", range(3))
def test_a_frame_that_the_networks_fail_on_fails_alone(room: Path, store: Store, expected: Any, position: int) -> None:
    frame = KEYFRAMES[3 + position]
    bad = pixels(room, frame)
    seen = Bright(lambda images: any(np.array_equal(image, bad) for image in images))
    summary = ingest(room, store, describer(3, seen))
    assert list(summary.failed) == [frame]
    assert summary.failed[frame].endswith(": bright: does not see")
    alone = [1, 1, 1]
    alone.insert(position + 1, 1)  # noise, to see whether it is the frame or the detector
    assert seen.given == [3, 3, *alone, 2]
    assert content(store)["frames"] == [row for row in expected["frames"] if row[0] != frame]


def test_a_batch_that_is_too_much_is_done_one_by_one(
    room: Path, store: Store, expected: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    events: list[tuple[str, dict[str, Any]]] = []
    monkeypatch.setattr("semdb.ingestion.work.event", lambda name, **fields: events.append((name, fields)))
    seen = Bright(lambda images: len(images) > 2)
    assert ingest(room, store, describer(3, seen)).stored == 8
    said = [fields for name, fields in events if name == "one_by_one"]
    assert said == [{"frames": 3, "error": "ModelError: bright: does not see"}] * 2
    assert seen.given == [3, 1, 1, 1, 3, 1, 1, 1, 2]
    assert content(store) == expected


def test_frames_of_another_size_than_the_camera_fail_alone(
    room: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Recording.read

    def cut(self: Recording, entry: FrameEntry) -> Frame:
        frame = read(self, entry)
        return dataclasses.replace(frame, image=frame.image[:100]) if entry.index == 6 else frame

    monkeypatch.setattr(Recording, "read", cut)
    summary = ingest(room, store, describer(3))
    assert (list(summary.failed), summary.stored) == ([6], 7)
    assert "the image is 320x100 but its camera is 320x240" in summary.failed[6]


@pytest.mark.parametrize("batch", [1, 3])
def test_networks_that_fail_on_everything_end_the_ingest_and_no_frame_is_failed(
    room: Path, store: Store, expected: Any, batch: int
) -> None:
    calls: list[int] = []

    def lost(images: Sequence[ImageArray]) -> bool:
        calls.append(len(images))
        return len(calls) > 2

    with pytest.raises(ModelError, match="bright: does not see"):
        ingest(room, store, describer(batch, Bright(lost)))
    assert store.failed_items() == []
    left, held = items.left(store.engine, 1)
    assert 8 - 2 * batch <= left <= 8  # what was described when all ended may not have been stored any more
    assert held == 0
    assert ingest(room, store, describer(batch)).stored == left
    assert content(store) == expected


def test_images_in_memory_do_not_grow_with_the_recording(
    room: Path, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two threads, batches of 3: one that is read, two that are described, one that waits or is stored."""
    read, write = Recording.read, Store.write_keyframe
    count = {"read": 0, "stored": 0, "most": 0}

    def reading(self: Recording, entry: FrameEntry) -> Frame:
        count["read"] += 1
        count["most"] = max(count["most"], count["read"] - count["stored"])
        return read(self, entry)

    def slowly(self: Store, *arguments: Any) -> Any:
        time.sleep(0.02)
        written = write(self, *arguments)
        count["stored"] += 1
        return written

    monkeypatch.setattr(Recording, "read", reading)
    monkeypatch.setattr(Store, "write_keyframe", slowly)
    [recording] = open_recordings(room)
    made = [describer(3, seen) for seen in [Bright()] for _ in range(2)]
    assert ingest_recording(recording, store, made, IngestOptions(stride=1, map_name="m")).stored == 24
    assert 6 < count["most"] <= 12


# the networks in torch, as commands and workers take them


@pytest.fixture
def torch_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Settings]:
    """Settings with small networks of random weights; `given` notes how many images each pass of the detector had."""
    import torch
    import torchvision

    from semdb.perception.detectors import torchvision as detectors
    from semdb.perception.mask_rcnn import Architecture
    from tests.unit.torch_checkpoints import light, mask_rcnn

    small = Architecture("resnet18", min_size=64, max_size=128, channels=32)
    made = {"format": "semdb-detector", "architecture": dataclasses.asdict(small), "classes": ["background", "cup"]}
    torch.save({**made, "model": mask_rcnn(small, 2).state_dict()}, tmp_path / "cups.pth")
    torch.save(torchvision.models.resnet18(weights=None).state_dict(), tmp_path / "r18.pth")
    run = detectors.TorchvisionDetector.detect_batch
    given: list[int] = []

    def detect_batch(self: Any, images: Sequence[ImageArray]) -> Any:
        given.append(len(images))
        light(self._network)
        return run(self, images)

    monkeypatch.setattr(detectors.TorchvisionDetector, "detect_batch", detect_batch)

    def settings(name: str, batch: int | str) -> Settings:
        return Settings(
            database_url=f"sqlite:///{tmp_path / name}",
            detector=f"torchvision:{tmp_path}/cups.pth",
            encoder=f"torchvision:{tmp_path}/r18.pth",
            features="orb",
            device="cpu",
            threads=1,
            batch=batch,  # type: ignore[arg-type]
        )

    settings.given = given  # type: ignore[attr-defined]
    return settings


def assert_equal_within_rounding(one: Store, other: Store) -> None:
    keyframes = [list(store.load_keyframes(store.keyframe_ids(1))) for store in (one, other)]
    assert [k.frame_index for k in keyframes[0]] == [k.frame_index for k in keyframes[1]]
    for a, b in zip(*keyframes, strict=True):
        assert len(a.objects) == len(b.objects) > 0
        np.testing.assert_allclose([o.score for o in a.objects], [o.score for o in b.objects], atol=1e-4)
        np.testing.assert_allclose([o.box for o in a.objects], [o.box for o in b.objects], rtol=0, atol=1e-3)
        np.testing.assert_array_equal(a.keypoints.features.descriptors, b.keypoints.features.descriptors)
    vectors = [store.load_vectors([k.id for k in found]) for store, found in zip((one, other), keyframes, strict=True)]
    np.testing.assert_allclose(vectors[0], vectors[1], atol=1e-4)


def test_torch_in_batches_by_a_command_and_by_a_worker(room: Path, torch_settings: Any) -> None:
    outbox = Outbox()
    names = ("one", "command", "worker")
    own = [torch_settings(name, batch) for name, batch in zip(names, ("auto", 3, 4), strict=True)]
    counts = []
    for which in (0, 1):
        torch_settings.given.clear()
        assert ingest_recordings([room], own[which], OPTIONS)[0].stored == 8
        counts.append(list(torch_settings.given))
    queue_recordings([str(room)], own[2], OPTIONS, outbox.send)
    torch_settings.given.clear()
    assert Workplace(own[2]).do(*outbox[0]).stored == 8
    counts.append(list(torch_settings.given))
    assert counts == [[1] * 8, [3, 3, 2], [4, 4]]
    with open_store(own[0].database_url) as one:
        for settings in own[1:]:
            with open_store(settings.database_url) as other:
                assert_equal_within_rounding(one, other)
                assert one.map_models(1) == other.map_models(1)


def test_how_many_are_taken_at_once(torch_settings: Any) -> None:
    import torch

    from semdb.perception.describe import describer_from_specs
    from semdb.perception.torch_models import best_batch

    assert [best_batch(torch.device(name)) for name in ("cpu", "cuda:1", "mps")] == [1, 8, 8]
    own = torch_settings("a", "auto")
    assert describer_from_specs(own.detector, own.encoder, "orb", own).batch == 1
    assert describer_from_specs("recorded", own.encoder, "orb", torch_settings("a", 5)).batch == 5
    assert describer_from_specs("recorded", "gist", "orb", torch_settings("a", 5)).batch == 1  # take one at a time
    assert describer().batch == Bright.best_batch


def test_the_setting(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert load_settings().batch == "auto"
    monkeypatch.setenv("SEMDB_BATCH", "6")
    assert load_settings().batch == 6
    assert Overrides().settings(batch=None).batch == 6
    assert Overrides().settings(batch="12").batch == 12
    assert Overrides().settings(batch="auto").batch == "auto"
    for wrong in ("0", "65", "many", "1.5"):
        monkeypatch.setenv("SEMDB_BATCH", wrong)
        with pytest.raises(UsageError, match=rf"^SEMDB_BATCH={wrong}: .*auto.*SEMDB_BATCH={wrong}: .*(than|integer)"):
            load_settings()
    done = CliRunner().invoke(app, ["ingest", str(tmp_path), "--batch", "0"])
    assert done.exit_code == 2
    assert "--batch=0: Input should be" in done.stderr
