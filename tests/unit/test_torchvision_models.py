"""The networks in torch, on checkpoints in the publishers' formats with random weights."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import pickle
import types
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import torchvision

from semdb.errors import ModelError, UsageError
from semdb.perception import torch_models
from semdb.perception.catalogue import BY_NAME
from semdb.perception.describe import View, describer_from_specs
from semdb.perception.detectors import load_detector
from semdb.perception.detectors import torchvision as detectors
from semdb.perception.encoders import load_encoder
from semdb.perception.encoders.crops import square
from semdb.perception.mask_rcnn import Architecture, build, modern_names
from semdb.settings import Settings
from semdb.types import Camera
from tests.unit.torch_checkpoints import light, mask_rcnn, old_names, write_places365

SMALL = Architecture("resnet18", min_size=64, max_size=128)


def settings(threshold: float = 0.5, **more: object) -> Settings:
    return Settings(score_threshold=threshold, threads=1, device="cpu", **more)  # type: ignore[arg-type]


def picture(seed: int, height: int = 96, width: int = 128) -> np.ndarray:
    """Blots of many sizes: smooth enough that a network sees something."""
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.integers(0, 255, (n, n, 3), dtype=np.uint8), (width, height)) for n in (3, 8, 24)]
    return np.mean(layers, axis=0).astype(np.uint8)


def load_light(spec: str, **more: object) -> Any:
    detector: Any = load_detector(spec, settings(**more))
    light(detector._network)
    return detector


def trained(path: Path, architecture: Architecture = SMALL, classes: tuple[str, ...] = ("background", "cup")) -> str:
    """A checkpoint in the format of semdb train; its spec."""
    network = mask_rcnn(architecture, len(classes))
    content = {
        "format": "semdb-detector",
        "architecture": dataclasses.asdict(architecture),
        "classes": list(classes),
        "model": network.state_dict(),
    }
    torch.save(content, path)
    return f"torchvision:{path}"


def test_published_files_are_those_that_torchvision_names() -> None:
    from torchvision.models import ResNet50_Weights
    from torchvision.models.detection import MaskRCNN_ResNet50_FPN_V2_Weights, MaskRCNN_ResNet50_FPN_Weights

    known = {
        "maskrcnn_resnet50_fpn": MaskRCNN_ResNet50_FPN_Weights.COCO_V1,
        "maskrcnn_resnet50_fpn_v2": MaskRCNN_ResNet50_FPN_V2_Weights.COCO_V1,
        "resnet50": ResNet50_Weights.IMAGENET1K_V1,
    }
    for name, weights in known.items():
        assert BY_NAME[name].url == weights.url
        assert weights.url.endswith("/" + BY_NAME[name].file)
        assert weights.url.endswith(f"-{BY_NAME[name].sha256}.pth")


@pytest.fixture
def small_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The published architectures on images of 96 pixels instead of 800, which take seconds here."""
    small = {name: dataclasses.replace(a, min_size=96, max_size=160) for name, a in detectors._PUBLISHED.items()}
    monkeypatch.setattr(detectors, "_PUBLISHED", small)


@pytest.mark.usefixtures("small_sizes")
@pytest.mark.parametrize("name", ["maskrcnn_resnet50_fpn", "maskrcnn_resnet50_fpn_v2"])
def test_published_mask_rcnn_gives_what_torchvision_gives(name: str, tmp_path: Path) -> None:
    """The reference is torchvision's own function for the name, as its users call it."""
    torch.manual_seed(0)
    version = 2 if name.endswith("v2") else 1
    source = mask_rcnn(Architecture("resnet50", version))
    state = source.state_dict() if version == 2 else old_names(source.state_dict())
    (tmp_path / "models").mkdir()
    path = tmp_path / "models" / BY_NAME[name].file
    torch.save(state, path)
    detector = load_light(f"torchvision:{name}", cache_dir=tmp_path)
    assert detector.info.name == f"torchvision:{name}"
    assert detector.info.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    config = json.loads(detector.info.config)
    assert config["batch_norm_epsilon"] == (0.0 if version == 1 else 1e-5)
    assert (config["score_threshold"], config["architecture"]) == (0.5, name)

    reference = getattr(torchvision.models.detection, name)(
        weights=None, weights_backbone=None, min_size=96, max_size=160
    ).eval()
    light(reference).load_state_dict(source.state_dict(), strict=False)
    if version == 1:
        torchvision.models.detection._utils.overwrite_eps(reference, 0.0)  # as torchvision does for these weights
        for module in reference.modules():
            if isinstance(module, torch.nn.BatchNorm2d):  # a network without weights has no frozen ones
                module.eps = 0.0
    image = picture(1)
    with torch.inference_mode():
        expected = reference([torch.from_numpy(image).permute(2, 0, 1).float() / 255])[0]
    found = detector.detect(image, None)
    keep = expected["scores"] >= 0.5
    assert 2 <= len(found) == int(keep.sum())
    np.testing.assert_allclose([d.score for d in found], expected["scores"][keep], atol=1e-4)
    boxes = np.clip(expected["boxes"][keep].numpy(), 0, [127, 95, 127, 95])
    np.testing.assert_allclose(np.array([d.box for d in found]), boxes, atol=1e-2)
    for detection, mask in zip(found, expected["masks"][keep].numpy(), strict=True):
        assert np.mean(detection.mask != (mask[0] >= 0.5)) < 1e-3


@pytest.mark.parametrize("backbone", ["resnet18", "resnet101"])
def test_a_checkpoint_by_path_is_recognised(backbone: str, tmp_path: Path) -> None:
    state = build(Architecture(backbone), 91).state_dict()
    torch.save(state, tmp_path / "mine.pth")
    detector = load_detector(f"torchvision:{tmp_path}/mine.pth", settings())
    assert detector.info.name == "torchvision:mine.pth"
    assert json.loads(detector.info.config)["architecture"] == f"maskrcnn_{backbone}_fpn"


def test_resnet101_gives_what_torchvision_gives(tmp_path: Path) -> None:
    """The paper's backbone, which has no published file: the reference is built from torchvision's parts alone."""
    path = tmp_path / "mask_rcnn_r101.pth"
    torch.save(mask_rcnn(Architecture("resnet101")).state_dict(), path)
    detector = load_light(f"torchvision:{path}", threshold=0.05)

    body = torchvision.models.detection.backbone_utils.resnet_fpn_backbone(backbone_name="resnet101", weights=None)
    reference = light(torchvision.models.detection.MaskRCNN(body, num_classes=91).eval())
    reference.load_state_dict(torch.load(path, weights_only=True), strict=True)
    for network in (detector._network, reference):
        network.transform.min_size, network.transform.max_size = (160,), 320  # of 800 and 1333: seconds
    image = picture(1)
    with torch.inference_mode():
        [expected] = reference([torch.from_numpy(image).permute(2, 0, 1).float() / 255])
    [found] = detector._run([image])
    assert len(expected["scores"]) == 6
    assert expected["labels"].tolist() == found["labels"].tolist()
    for name in ("boxes", "scores", "masks"):
        assert expected[name].shape == found[name].shape
        np.testing.assert_allclose(found[name].numpy(), expected[name].numpy(), atol=1e-4)
    assert expected["masks"].max() - expected["masks"].min() > 0.5
    names = torchvision.models.detection.MaskRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]
    assert [d.category for d in detector.detect(image, None)] == [names[k] for k in expected["labels"]]


def test_old_names_become_new_ones() -> None:
    state = build(Architecture("resnet18"), 3).state_dict()
    assert list(old_names(state)) != [name for name in state if not name.endswith("num_batches_tracked")]
    assert set(modern_names(old_names(state))) == {name for name in state if not name.endswith("num_batches_tracked")}


def test_trained_checkpoint_brings_its_classes_and_sizes(tmp_path: Path) -> None:
    detector = load_light(trained(tmp_path / "cups.pth"))
    found = detector.detect(picture(2), None)
    assert found
    assert {d.category for d in found} == {"cup"}
    scores = [d.score for d in found]
    assert scores == sorted(scores, reverse=True)
    assert min(scores) >= 0.5
    assert all(d.mask.shape == (96, 128) and d.mask.any() and d.mask.dtype == np.bool_ for d in found)
    assert json.loads(detector.info.config)["min_size"] == 64


def test_batch_and_single_agree(tmp_path: Path) -> None:
    detector = load_light(trained(tmp_path / "cups.pth"))
    images = [picture(3), picture(4, 128, 96), picture(5), picture(6), picture(7, 128, 96)]
    batch = detector.detect_batch(images)
    for image, together in zip(images, batch, strict=True):
        alone = detector.detect(image, None)
        assert len(alone) == len(together) > 0
        for a, b in zip(alone, together, strict=True):
            assert a.category == b.category
            assert abs(a.score - b.score) < 1e-4
            np.testing.assert_allclose(a.box, b.box, rtol=0, atol=1e-4)
            assert np.mean(a.mask != b.mask) < 1e-3
    assert detector.detect_batch([]) == []


def test_images_described_at_once_are_as_one_by_one(tmp_path: Path) -> None:
    """One pass of the encoder for all, one of the detector for each size."""
    torch.save(torchvision.models.resnet18(weights=None).state_dict(), tmp_path / "r18.pth")
    specs = (trained(tmp_path / "cups.pth"), f"torchvision:{tmp_path}/r18.pth", "surf")
    describer: Any = describer_from_specs(*specs, settings())
    light(describer.detector._network)
    passes: list[tuple[int, ...]] = []
    for network in (describer.detector._network.backbone, describer.encoder._network):
        network.register_forward_hook(lambda m, inputs, result: passes.append(tuple(inputs[0].shape)))
    views = []
    for seed, (height, width) in enumerate([(96, 128), (128, 96), (96, 128)]):
        camera = Camera(width, height, 100.0, 100.0, width / 2, height / 2)
        views.append(View(picture(seed, height, width), np.full((height, width), 2, np.float32), camera))
    together = describer.describe_batch(views)
    assert passes == [(2, 3, 64, 96), (1, 3, 96, 64), (3, 3, 224, 224)]
    for view, one in zip(views, together, strict=True):
        alone = describer.describe(view.image, view.depth, view.camera)
        assert len(alone.detections) == len(one.detections) > 0
        np.testing.assert_allclose([d.score for d in alone.detections], [d.score for d in one.detections], atol=1e-4)
        np.testing.assert_allclose(alone.cnn_vector, one.cnn_vector, atol=1e-4)
        assert len(alone.sightings) == len(one.sightings)
        np.testing.assert_array_equal(alone.keypoints.features.xy, one.keypoints.features.xy)
        np.testing.assert_allclose(alone.geometry[0].centroid, one.geometry[0].centroid, atol=0.05)
        assert set(one.timing_ms) == {"detect", "encode", "features"}
    assert describer.describe_batch([]) == []


def test_half_precision_gives_nearly_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs in half precision on a GPU runs in bfloat16 on the CPU here: coarser than float16, same code."""
    spec = trained(tmp_path / "cups.pth")
    image = picture(8, 48, 64)
    exact = load_light(spec).detect(image, None)
    monkeypatch.setattr(detectors, "layer_precision", lambda device, torch: torch.autocast("cpu", dtype=torch.bfloat16))
    half = load_light(spec).detect(image, None)
    assert half
    assert abs(half[0].score - exact[0].score) < 0.02
    assert half[0].box.dtype == np.float32


def test_boxes_are_exact_in_half_precision(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers run in bfloat16, whose numbers from 64 on are half a pixel apart; anchors, regions and boxes do not."""
    seen: list[Any] = []
    detector = load_light(trained(tmp_path / "cups.pth"))
    network = detector._network
    network.rpn.anchor_generator.register_forward_hook(lambda m, i, anchors: seen.extend(anchors))
    network.rpn.register_forward_hook(lambda m, i, result: seen.extend(result[0]))
    network.backbone.fpn.layer_blocks[0].register_forward_hook(lambda m, i, result: seen.append(result))
    monkeypatch.setattr(detectors, "layer_precision", lambda device, torch: torch.autocast("cpu", dtype=torch.bfloat16))
    found = detector.detect(picture(8), None)
    assert [tensor.dtype for tensor in seen] == [torch.bfloat16, torch.float32, torch.float32]
    boxes = torch.from_numpy(np.array([d.box for d in found]))
    assert (boxes != boxes.bfloat16().float()).float().mean() > 0.5


def test_weak_detections_cost_no_mask(tmp_path: Path) -> None:
    """What is found is what torchvision finds; masks are computed for those that are stored as objects alone."""
    spec, image = trained(tmp_path / "cups.pth"), picture(2)
    every = load_light(spec, threshold=0.05).detect(image, None)
    threshold = (every[1].score + every[2].score) / 2
    detector = load_light(spec, threshold=threshold)
    masks: list[int] = []
    detector._network.roi_heads.mask_head.register_forward_hook(lambda m, i, result: masks.append(len(result)))
    found = detector.detect(image, None)
    assert masks == [2]
    assert [d.weak for d in found] == [False, False, *(True for _ in every[2:])]
    assert [d.score for d in found] == pytest.approx([d.score for d in every])
    assert all(np.array_equal(a.mask, b.mask) for a, b in zip(found[:2], every, strict=False))
    with torch.inference_mode():
        (expected,) = detector._network([detectors.image_tensor(image, torch)])
    np.testing.assert_allclose([d.score for d in found], expected["scores"], atol=1e-6)
    none = load_light(spec, threshold=1.0).detect(image, None)
    assert len(none) == len(every)
    assert all(d.weak and d.mask.size == 0 for d in none)


def test_images_go_to_the_device_as_bytes() -> None:
    images = [picture(seed) for seed in (1, 2, 3)]
    found = detectors.image_tensors(images, torch.device("cpu"), torch)
    assert len(found) == 3
    for image, tensor in zip(images, found, strict=True):
        assert tensor.is_contiguous()
        assert torch.equal(tensor, detectors.image_tensor(image, torch))


@pytest.mark.parametrize("python2", [False, True])
def test_places365_features_are_those_before_the_last_layer(python2: bool, tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    network = write_places365(tmp_path / "models" / "resnet50_places365.pth.tar", python2=python2)
    encoder: Any = load_encoder("torchvision:resnet50-places365", settings(cache_dir=tmp_path))
    assert encoder.info.name == "torchvision:resnet50-places365"
    images = [picture(10, 240, 320), picture(11, 300, 260), picture(12, 240, 320)]
    batch = encoder.encode_batch(images)
    assert batch.shape == (3, 2048)
    assert batch.dtype == np.float32
    mean, deviation = np.array([0.485, 0.456, 0.406])[:, None, None], np.array([0.229, 0.224, 0.225])[:, None, None]
    found = {}
    network.avgpool.register_forward_hook(lambda module, inputs, output: found.update(x=output.flatten(1)))
    for image, vector in zip(images, batch, strict=True):
        with torch.inference_mode():
            network(torch.from_numpy(((square(image, "centre")[0] - mean) / deviation)[None]).float())
        expected = found["x"][0].numpy()
        np.testing.assert_allclose(vector, expected / np.linalg.norm(expected), atol=1e-4)
        np.testing.assert_allclose(encoder.encode(image), vector, atol=1e-4)
        assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-5)


def test_places365_with_other_outputs_is_another_network(tmp_path: Path) -> None:
    (tmp_path / "models").mkdir()
    write_places365(tmp_path / "models" / "resnet50_places365.pth.tar", outputs=1000)
    with pytest.raises(ModelError, match=r"resnet50_places365\.pth\.tar has 1000 outputs, but should have 365"):
        load_encoder("torchvision:resnet50-places365", settings(cache_dir=tmp_path))


def test_imagenet_resnet_and_smaller_ones_by_path(tmp_path: Path) -> None:
    torch.save(torchvision.models.resnet18(weights=None).state_dict(), tmp_path / "r18.pth")
    encoder = load_encoder(f"torchvision:{tmp_path}/r18.pth", settings())
    assert encoder.encode(picture(1)).shape == (512,)


@pytest.mark.parametrize("name", ["maskrcnn_resnet50_fpn_v2", "resnet50-places365"])
def test_missing_file_says_how_to_get_it(name: str, tmp_path: Path) -> None:
    load = load_detector if name.startswith("mask") else load_encoder
    with pytest.raises(ModelError) as caught:
        load(f"torchvision:{name}", settings(cache_dir=tmp_path))  # type: ignore[operator]
    text = str(caught.value)
    assert f"semdb models pull {name}" in text
    assert str(tmp_path / "models" / BY_NAME[name].file) in text


def test_a_spec_that_is_none_is_an_error(tmp_path: Path) -> None:
    for spec in ("onnx:a.onnx", "maskrcnn_resnet50_fpn"):
        with pytest.raises(UsageError, match="write torchvision:PATH, or torchvision:NAME with one of maskrcnn"):
            torch_models.resolve_checkpoint(spec, settings(cache_dir=tmp_path))
    with pytest.raises(ModelError, match=r"no model file at .*published models are maskrcnn_resnet50_fpn_v2, "):
        torch_models.resolve_checkpoint("torchvision:maskrcnn_resnet101", settings(cache_dir=tmp_path))


class _Runs:
    def __reduce__(self) -> tuple[Any, ...]:
        return (print, ("code was run",))


def test_wrong_files_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "file.pth"

    def error(loader: Any = load_detector) -> str:
        with pytest.raises(ModelError) as caught:
            loader(f"torchvision:{path}", settings())
        assert str(path) in str(caught.value)
        return str(caught.value)

    path.write_bytes(b"no checkpoint at all" * 10)
    assert "cannot be read as a torch checkpoint: it begins with b'no c'" in error()
    torch.save({"model": build(SMALL, 3).state_dict(), "extra": 1}, path)
    assert "knows 3 classes, but without a list of names they must be COCO's 91" in error()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    assert "cannot be read" in error()
    path.write_bytes(pickle.dumps({"state_dict": _Runs()}))
    assert "code" in error()
    torch.save([1, 2], path)
    assert "holds a list, not weights" in error()
    torch.save({"epoch": 3}, path)
    assert "holds no weights" in error()
    torch.save(torchvision.models.resnet18(weights=None).state_dict(), path)
    assert "is no checkpoint of torchvision's Mask R-CNN" in error()
    state = build(SMALL, 91).state_dict()
    torch.save(state, path)
    assert "is no checkpoint of torchvision's ResNet" in error(load_encoder)
    torch.save({**state, "rpn.head.cls_logits.weight": torch.zeros(3, 9, 1, 1)}, path)
    assert "rpn.head.cls_logits.weight is [3, 9, 1, 1], wanted is [3, 256, 1, 1]" in error()
    del state["backbone.fpn.layer_blocks.2.0.bias"]
    torch.save({**state, "surplus": torch.zeros(1)}, path)
    assert "1 missing (backbone.fpn.layer_blocks.2.0.bias) and 1 that it does not know (surplus)" in error()
    assert "code was run" not in capsys.readouterr().out


def fake_torch(cuda: int, mps: bool) -> Any:
    return types.SimpleNamespace(
        device=torch.device,
        cuda=types.SimpleNamespace(is_available=lambda: cuda > 0, device_count=lambda: cuda),
        backends=types.SimpleNamespace(mps=types.SimpleNamespace(is_available=lambda: mps)),
    )


@pytest.mark.parametrize(
    ("name", "cuda", "mps", "chosen"),
    [
        ("auto", 0, False, "cpu"),
        ("auto", 0, True, "mps"),
        ("auto", 2, True, "cuda"),
        ("cpu", 2, True, "cpu"),
        ("cuda", 1, False, "cuda"),
        ("cuda:1", 2, False, "cuda:1"),
        ("mps", 0, True, "mps"),
    ],
)
def test_device(name: str, cuda: int, mps: bool, chosen: str) -> None:
    assert torch_models.choose_device(name, fake_torch(cuda, mps)) == torch.device(chosen)


@pytest.mark.parametrize(
    ("name", "cuda", "message"),
    [("cuda", 0, "finds no CUDA"), ("cuda:2", 2, "there are 2 CUDA devices"), ("mps", 0, "finds no Metal")],
)
def test_a_device_that_is_not_there_is_an_error(name: str, cuda: int, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        torch_models.choose_device(name, fake_torch(cuda, False))


def test_half_precision_is_for_cuda_only() -> None:
    made = []
    fake = types.SimpleNamespace(autocast=lambda *a, **k: made.append((a, k)), float16="half")
    for device in ("cpu", "mps", "cuda:1"):
        torch_models.layer_precision(torch.device(device), fake)
    assert made == [(("cuda",), {"dtype": "half"})]


def test_without_torch_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(ModelError, match=r"pip install 'semdb\[torch\]'.*onnx:FILE"):
        load_detector("torchvision:maskrcnn_resnet50_fpn_v2", settings())
