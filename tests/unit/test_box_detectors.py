"""Detectors of boxes, and masks that are made of boxes and depth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import torchvision

from semdb.errors import ModelError
from semdb.perception.box_masks import box_mask, depth_cluster_mask, filled
from semdb.perception.detectors import load_detector
from semdb.settings import Settings
from semdb.types import Detection, InstanceMasks

SETTINGS = Settings(threads=1, device="cpu")


def test_a_box_is_filled_with_its_last_pixel_and_cut_at_the_image() -> None:
    mask = box_mask([2, 1, 4, 3], (6, 8))
    assert mask.sum() == 9
    assert mask[1:4, 2:5].all()
    assert box_mask([-5, -5, 100, 100], (6, 8)).all()
    assert box_mask([50, 50, 60, 60], (6, 8)).sum() == 1


def test_depth_finds_the_object_in_front_of_a_wall_and_behind_a_post() -> None:
    rng = np.random.default_rng(0)
    depth = np.full((60, 80), 3.0, dtype=np.float32)  # a wall
    rows, columns = np.mgrid[:60, :80]
    disc = (rows - 30) ** 2 + (columns - 40) ** 2 < 14**2
    depth[disc] = 1.5
    post = (columns > 27) & (columns < 31)
    depth[post] = 0.6
    depth += rng.normal(0, 0.005, depth.shape).astype(np.float32)
    depth[28:30, 38:42] = np.nan
    mask = depth_cluster_mask([26, 16, 54, 44], depth)
    truth = disc & ~post & np.isfinite(depth)
    assert np.array_equal(mask, truth)
    box = box_mask([26, 16, 54, 44], depth.shape)
    assert (box & truth).sum() / box.sum() < 0.7  # what the box alone would be


def test_without_depth_a_box_is_its_mask_and_weak_detections_have_none() -> None:
    box = np.array([1, 1, 5, 4], dtype=np.float32)
    none = np.zeros((0, 0), dtype=np.bool_)
    sure = Detection("cup", 0.9, box, none)
    weak = replace(sure, score=0.1, weak=True)
    holes = np.full((8, 8), np.nan, dtype=np.float32)
    for depth in (None, holes):
        found = filled([sure, weak], depth, (8, 8))
        assert found[0].mask.sum() == 20
        assert found[1].mask.size == 0


@pytest.mark.long
@pytest.mark.parametrize(("spec", "name"), [("fasterrcnn", "fasterrcnn_resnet50_fpn"), ("ssd", "ssd300_vgg16")])
def test_checkpoints_of_torchvision_are_detectors(tmp_path: Path, spec: str, name: str) -> None:
    torch.manual_seed(0)
    network = getattr(torchvision.models.detection, name)(weights=None, weights_backbone=None, num_classes=91)
    path = tmp_path / "net.pth"
    torch.save(network.state_dict(), path)
    detector = load_detector(f"{spec}:{path}", Settings(threads=1, device="cpu", score_threshold=0.05))
    found = detector.detect(np.zeros((32, 32, 3), dtype=np.uint8), None)
    assert all(detection.mask.shape in {(32, 32), (0, 0)} for detection in found)
    assert detector.info.name == f"{spec}:net.pth"
    assert name in detector.info.config
    with pytest.raises(ModelError, match="no checkpoint of"):
        load_detector(f"{'ssd' if spec == 'fasterrcnn' else 'fasterrcnn'}:{path}", SETTINGS)


def test_boxes_of_another_detector_forget_its_masks() -> None:
    labels = np.zeros((40, 48), dtype=np.uint16)
    labels[8:12, 12:36] = labels[8:32, 12:16] = 1  # an angle
    instances = InstanceMasks(labels, {1: "chair"})
    image = np.zeros((40, 48, 3), dtype=np.uint8)
    [exact] = load_detector("recorded", SETTINGS).detect(image, instances)
    whole, deep = (load_detector(f"{kind}:recorded", SETTINGS) for kind in ("whole-boxes", "boxes"))
    [box] = whole.detect(image, instances)
    assert (exact.mask.sum(), box.mask.sum()) == (176, 576)
    assert (whole.info.name, deep.info.name) == ("whole-boxes:recorded", "boxes:recorded")
    assert not whole.boxes_only
    assert deep.boxes_only
