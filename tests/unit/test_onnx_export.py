"""torch networks as ONNX files: the same detections and vectors, at any image size, from the file as it is."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.errors import ModelError, UsageError
from semdb.perception.detectors import load_detector
from semdb.perception.encoders import load_encoder
from semdb.perception.mask_rcnn import Architecture
from semdb.perception.onnx_check import check_export, compare_detectors, compare_encoders
from semdb.perception.onnx_export import Exported, export
from semdb.settings import Settings
from semdb.types import Detection
from tests.unit.torch_checkpoints import mask_rcnn, write_places365

SETTINGS = Settings(threads=1, device="cpu")
SMALL = Architecture("resnet18", min_size=64, max_size=128, channels=32)
CLASSES = ("background", "cup", "chair")


def picture(seed: int, height: int, width: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.integers(0, 255, (n, n, 3), dtype=np.uint8), (width, height)) for n in (3, 8, 24)]
    return np.mean(layers, axis=0).astype(np.uint8)


def fill_boxes(network: Any) -> None:
    """Makes masks fill their boxes: random ones are near one half everywhere, where rounding counts."""
    with torch.no_grad():
        network.roi_heads.mask_predictor.mask_fcn_logits.weight.mul_(0.1)
        network.roi_heads.mask_predictor.mask_fcn_logits.bias += 2


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    network = mask_rcnn(SMALL, len(CLASSES))
    fill_boxes(network)
    content = {"format": "semdb-detector", "architecture": dataclasses.asdict(SMALL), "classes": list(CLASSES)}
    path = tmp_path_factory.mktemp("export") / "small.pth"
    torch.save({**content, "model": network.state_dict()}, path)
    return path


@pytest.fixture(scope="module")
def exported(checkpoint: Path) -> Exported:
    return export(f"torchvision:{checkpoint}", checkpoint.with_suffix(".onnx"), SETTINGS)


def test_detector_is_the_same_at_any_size(checkpoint: Path, exported: Exported) -> None:
    original, file = (
        load_detector(f"torchvision:{checkpoint}", SETTINGS),
        load_detector(f"onnx:{exported.path}", SETTINGS),
    )
    assert exported.role == "detector"
    assert file.classes == CLASSES
    for height, width in ((48, 64), (96, 128), (77, 53), (128, 96), (240, 320)):
        found = compare_detectors(original, file, [picture(height, height, width)], 0.5)
        assert found.objects > 5
        assert found.unpaired == 0
        assert found.box_px < 0.5
        assert found.score < 1e-3
        assert found.mask_iou > 0.99
        assert found.equal


@pytest.mark.long
def test_resnet101_is_the_same(tmp_path: Path) -> None:
    """The paper's backbone at a fifth of its size."""
    architecture = Architecture("resnet101", min_size=160, max_size=320)
    network = mask_rcnn(architecture, len(CLASSES))
    fill_boxes(network)
    content = {"format": "semdb-detector", "architecture": dataclasses.asdict(architecture), "classes": list(CLASSES)}
    torch.save({**content, "model": network.state_dict()}, tmp_path / "r101.pth")
    spec = f"torchvision:{tmp_path}/r101.pth"
    done = export(spec, tmp_path / "r101.onnx", SETTINGS)
    original, file = load_detector(spec, SETTINGS), load_detector(f"onnx:{done.path}", SETTINGS)
    found = compare_detectors(original, file, [picture(1, 96, 128)], 0.5)
    assert found.objects > 5
    assert found.equal
    assert found.box_px < 0.01
    assert found.score < 1e-4


def test_the_file_keeps_the_contract(checkpoint: Path, exported: Exported) -> None:
    import onnxruntime as ort

    session = ort.InferenceSession(exported.path, providers=["CPUExecutionProvider"])
    assert [(i.name, i.type, i.shape[:2]) for i in session.get_inputs()] == [("image", "tensor(float)", [1, 3])]
    assert [o.name for o in session.get_outputs()] == ["boxes", "labels", "scores", "masks"]
    metadata = session.get_modelmeta().custom_metadata_map
    assert json.loads(metadata["classes"]) == list(CLASSES)
    assert metadata["name"] == "small"
    assert "SHA-256" in metadata["source"]
    image = picture(5, 60, 90).transpose(2, 0, 1)[None].astype(np.float32) / 255
    boxes, labels, scores, masks = session.run(None, {"image": image})
    n = len(scores)
    assert (boxes.shape, labels.shape, masks.shape) == ((n, 4), (n,), (n, 1, 60, 90))
    assert (boxes.dtype, labels.dtype, scores.dtype, masks.dtype) == (np.float32, np.int64, np.float32, np.float32)
    assert (boxes >= 0).all()
    assert boxes[:, 2].max() <= 89
    assert boxes[:, 3].max() <= 59
    assert scores.min() >= 0.05
    assert (np.diff(scores) <= 0).all()
    assert list(checkpoint.parent.glob("*.new")) == []


def test_nothing_found_is_empty(tmp_path: Path) -> None:
    network = mask_rcnn(SMALL, len(CLASSES))
    with torch.no_grad():
        network.roi_heads.box_predictor.cls_score.bias[0] += 100
    content = {"format": "semdb-detector", "architecture": dataclasses.asdict(SMALL), "classes": list(CLASSES)}
    torch.save({**content, "model": network.state_dict()}, tmp_path / "blind.pth")
    done = export(f"torchvision:{tmp_path}/blind.pth", tmp_path / "blind.onnx", SETTINGS)
    assert load_detector(f"onnx:{done.path}", SETTINGS).detect(picture(1, 60, 90), None) == ()


def test_encoder_is_the_same(tmp_path: Path) -> None:
    write_places365(tmp_path / "resnet50_places365.pth.tar")
    spec = f"torchvision:{tmp_path}/resnet50_places365.pth.tar"
    done = export(spec, tmp_path / "places.onnx", SETTINGS)
    assert done.role == "encoder"
    images = [picture(1, 240, 320), picture(2, 300, 200)]
    original, file = load_encoder(spec, SETTINGS), load_encoder(f"onnx:{done.path}", SETTINGS)
    assert compare_encoders(original, file, images) < 1e-4
    assert file.encode(images[0]).shape == (2048,)


def test_a_target_without_a_folder_is_an_error(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"none/a\.onnx: .*none is no folder"):
        export(f"torchvision:{checkpoint}", tmp_path / "none" / "a.onnx", SETTINGS)


def test_a_difference_is_found() -> None:
    class Fixed:
        classes = CLASSES

        def __init__(self, *found: Detection) -> None:
            self.found = found

        def detect(self, image: Any, instances: Any) -> tuple[Detection, ...]:
            return self.found

    def thing(x: int, score: float = 0.9, category: str = "cup") -> Detection:
        mask = np.zeros((50, 50), dtype=bool)
        mask[10:30, x : x + 20] = True
        return Detection(category, score, np.array([x, 10, x + 19, 29], dtype=np.float32), mask)

    def compare(one: Fixed, other: Fixed) -> Any:
        return compare_detectors(one, other, [np.zeros((50, 50, 3), np.uint8)], 0.5)  # type: ignore[arg-type]

    assert compare(Fixed(thing(5)), Fixed(thing(5))).equal
    assert compare(Fixed(thing(5)), Fixed(thing(6))).box_px == 1
    assert compare(Fixed(thing(5)), Fixed(thing(6))).mask_iou == pytest.approx(19 / 21)
    assert compare(Fixed(thing(5)), Fixed(thing(5, 0.8))).score == pytest.approx(0.1)
    assert compare(Fixed(thing(5)), Fixed(thing(5, category="chair"))).unpaired == 2
    assert compare(Fixed(thing(5)), Fixed()).unpaired == 1
    assert compare(Fixed(thing(5, 0.5004)), Fixed()).unpaired == 0  # rounding may put it below the threshold


def test_command_exports_and_compares(checkpoint: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), picture(3, 90, 120))
    target = tmp_path / "a.onnx"
    arguments = ["models", "export", f"torchvision:{checkpoint}", str(target), "--check", str(tmp_path / "a.png")]
    done = CliRunner().invoke(app, arguments, env={"SEMDB_THREADS": "1"})
    assert done.exit_code == 0, done.output
    assert f"use it as onnx:{target}" in done.stdout
    assert "1 images, " in done.stdout
    other = Exported(target, "detector", "")
    wrong = tmp_path / "other.pth"
    content = torch.load(checkpoint, weights_only=True)
    content["model"]["roi_heads.box_predictor.cls_score.bias"][1] += 0.5
    torch.save(content, wrong)
    with pytest.raises(ModelError, match=r"a\.onnx is not what torchvision:.*other\.pth is"):
        check_export(other, f"torchvision:{wrong}", [picture(3, 90, 120)], SETTINGS)
