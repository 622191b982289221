"""What `auto` means, for an ingest and for a query."""

from __future__ import annotations

from pathlib import Path

import pytest

from semdb.errors import UsageError
from semdb.perception.model_choice import settings_of_map, specs_for_ingest, specs_for_query
from semdb.settings import Settings
from semdb.types import ModelInfo

MAP = (
    ModelInfo("detector", "onnx:mask.onnx", "ab" * 32, '{"mask_threshold":0.5,"score_threshold":0.3}'),
    ModelInfo("encoder", "gist", "", "{}"),
    ModelInfo("features", "sift", "", '{"max_keypoints":700}'),
)


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    for name in ("DETECTOR", "ENCODER", "FEATURES", "SCORE_THRESHOLD", "MAX_KEYPOINTS"):
        monkeypatch.delenv(f"SEMDB_{name}", raising=False)
    monkeypatch.chdir(tmp_path)
    return Settings(cache_dir=tmp_path / "cache")


def test_a_new_map_takes_what_needs_no_file_and_says_so(settings: Settings) -> None:
    specs = specs_for_ingest(settings, (), has_masks=True)
    assert (specs.detector, specs.encoder, specs.features) == ("recorded", "gist", "surf")
    assert len(specs.notes) == 2
    with pytest.raises(UsageError, match="SEMDB_DETECTOR=onnx:FILE"):
        specs_for_ingest(settings, (), has_masks=False)


def test_masks_that_are_not_there_cannot_be_the_detections(settings: Settings) -> None:
    named = settings.model_copy(update={"detector": "recorded"})
    assert specs_for_ingest(named, (), has_masks=True).detector == "recorded"
    with pytest.raises(UsageError, match="brings no object masks"):
        specs_for_ingest(named, (), has_masks=False)
    for spec in ("boxes:recorded", "whole-boxes:recorded"):
        with pytest.raises(UsageError, match=f"the detector is '{spec}', but this recording brings no object masks"):
            specs_for_ingest(settings.model_copy(update={"detector": spec}), (), has_masks=False)
    rendered = (ModelInfo("detector", "recorded", "", "{}"), *MAP[1:])
    with pytest.raises(UsageError, match="brings no object masks"):
        specs_for_ingest(settings, rendered, has_masks=False)


def test_what_is_named_is_taken_without_a_word(settings: Settings) -> None:
    named = settings.model_copy(update={"detector": "onnx:a.onnx", "encoder": "onnx:b.onnx", "features": "orb"})
    specs = specs_for_ingest(named, MAP, has_masks=True)
    assert (specs.detector, specs.encoder, specs.features, specs.notes) == ("onnx:a.onnx", "onnx:b.onnx", "orb", ())
    assert specs_for_query(named, MAP) == specs


def test_a_query_takes_the_maps_models_when_their_files_are_at_hand(settings: Settings, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"mask\.onnx.*abababababab.*SEMDB_DETECTOR"):
        specs_for_query(settings, MAP)
    file = settings.cache_dir / "models" / "mask.onnx"
    file.parent.mkdir(parents=True)
    file.write_bytes(b"weights")
    specs = specs_for_query(settings, MAP)
    assert (specs.detector, specs.encoder, specs.features) == (f"onnx:{file}", "gist", "sift")
    with pytest.raises(UsageError, match="no keyframe"):
        specs_for_query(settings, ())


def test_a_query_finds_detectors_of_boxes(settings: Settings) -> None:
    file = settings.cache_dir / "models" / "mask.onnx"
    for name in ("boxes:onnx:mask.onnx", "whole-boxes:onnx:mask.onnx", "ssd:mask.onnx"):
        of_map = (ModelInfo("detector", name, "ab" * 32, "{}"), *MAP[1:])
        with pytest.raises(
            UsageError, match=rf"mask\.onnx .sha256 abab.*SEMDB_DETECTOR={name.rpartition(':')[0]}:PATH"
        ):
            specs_for_query(settings, of_map)
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
        assert specs_for_query(settings, of_map).detector == name.replace("mask.onnx", str(file))
        file.unlink()


def test_the_maps_thresholds_hold_unless_others_are_set(settings: Settings) -> None:
    taken = settings_of_map(settings, MAP)
    assert (taken.score_threshold, taken.max_keypoints) == (0.3, 700)
    own = Settings(score_threshold=0.7)
    assert settings_of_map(own, MAP).score_threshold == 0.7


def test_a_query_finds_the_torch_models_of_its_map(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    settings = Settings(cache_dir=tmp_path, features="surf", detector="auto", encoder="auto")
    trained = ModelInfo("detector", "torchvision:kitchen.pth", "ab" * 32)
    places = ModelInfo("encoder", "torchvision:resnet50-places365", "cd" * 32)
    with pytest.raises(UsageError, match=r"detector torchvision:kitchen\.pth .*SEMDB_DETECTOR=torchvision:PATH"):
        specs_for_query(settings, (trained, places))
    (tmp_path / "models" / "kitchen.pth").touch()
    with pytest.raises(UsageError, match=r"fetch it with `semdb models pull resnet50-places365`"):
        specs_for_query(settings, (trained, places))
    (tmp_path / "models" / "resnet50_places365.pth.tar").touch()
    specs = specs_for_query(settings, (trained, places))
    assert specs.detector == f"torchvision:{tmp_path}/models/kitchen.pth"
    assert specs.encoder == "torchvision:resnet50-places365"
