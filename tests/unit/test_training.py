"""A few steps of training: what learns, what stays, and that a run which was cut off ends as if it had not been."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.errors import ModelError, TrainingError, UsageError
from semdb.perception.detectors import load_detector
from semdb.recordings.synthetic.coco import run_lengths
from semdb.settings import Settings
from semdb.training.coco import decode_rle, load_coco, mask_of, read_picture
from semdb.training.detector import CHECKPOINT, rate_at, train
from semdb.training.evaluation import PAPER, evaluate_detector
from semdb.training.options import TrainOptions
from semdb.training.stages import Stage, enter, make_stages, part_of
from semdb.training.start import adopt, first_network
from semdb.types import Detection, ImageArray, InstanceMasks, ModelInfo

SETTINGS = Settings(threads=1, device="cpu")
CLASSES = ("disc", "square")


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """COCO-format data of 12 pictures of 64x48 with a red disc and a blue square on noise."""
    folder = tmp_path_factory.mktemp("shapes")
    (folder / "train").mkdir()
    (folder / "annotations").mkdir()
    images, annotations = [], []
    rng = np.random.default_rng(0)
    for number in range(1, 13):
        image = rng.integers(90, 140, (48, 64, 3), dtype=np.uint8)
        for category, x in ((1, 16), (2, 46)):
            mask = np.zeros((48, 64), dtype=np.uint8)
            centre = (x + int(rng.integers(-4, 5)), 24 + int(rng.integers(-8, 9)))
            if category == 1:
                cv2.circle(mask, centre, 9, 1, -1)
            else:
                cv2.rectangle(mask, (centre[0] - 8, centre[1] - 8), (centre[0] + 8, centre[1] + 8), 1, -1)
            image[mask > 0] = (220, 30, 30) if category == 1 else (30, 30, 220)
            x0, y0, w, h = cv2.boundingRect(mask)
            rle = {"size": [48, 64], "counts": run_lengths(mask.astype(bool))}
            row = {"id": len(annotations) + 1, "image_id": number, "category_id": category, "iscrowd": 0}
            annotations.append({**row, "bbox": [x0, y0, w, h], "area": int(mask.sum()), "segmentation": rle})
        name = f"{number}.png"
        cv2.imwrite(str(folder / "train" / name), image[..., ::-1])
        images.append({"id": number, "file_name": name, "width": 64, "height": 48})
    categories = [{"id": 1, "name": "disc"}, {"id": 2, "name": "square"}]
    content = {"images": images, "annotations": annotations, "categories": categories}
    (folder / "annotations" / "instances_train.json").write_text(json.dumps(content))
    return folder


def tiny(coco: Path, output: Path, **more: Any) -> TrainOptions:
    options = TrainOptions(coco, output, weights=None, backbone="resnet18", min_size=48, max_size=64, anchor=8)
    small = {"channels": 16, "batch": 4, "rois": 16, "optimizer": "adamw", "rates": (2e-3, 2e-3, 2e-3)}
    return replace(options, **(small | {"epochs": (0, 0, 4)} | more))


def weights(path: Path) -> dict[str, Any]:
    content = torch.load(path, weights_only=True)
    return dict(content["model"])


def test_the_loss_falls(shapes: Path, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    done = train(tiny(shapes, tmp_path), SETTINGS, progress=lambda step, total: seen.append((step, total)))
    assert seen == [(step, 12) for step in range(13)]
    assert np.mean(done.losses[-3:]) < 0.6 * np.mean(done.losses[:3])
    rows = list(csv.DictReader(done.curves.open()))
    assert [int(row["step"]) for row in rows] == list(range(1, 13))
    assert float(rows[-1]["loss"]) == pytest.approx(done.losses[-1], rel=1e-5)
    detector = load_detector(f"torchvision:{done.checkpoint}", Settings(score_threshold=0.05, threads=1, device="cpu"))
    assert detector.classes == ("background", *CLASSES)
    assert {d.category for d in detector.detect(np.zeros((48, 64, 3), np.uint8), None)} <= set(CLASSES)


def test_mixed_precision_learns_the_same(shapes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The step of a GPU in bfloat16 on the CPU, which is coarser than float16: weights and losses stay float32."""
    exact = train(tiny(shapes, tmp_path / "exact"), SETTINGS, stop_after=3)
    monkeypatch.setattr(
        "semdb.training.detector.layer_precision", lambda device, torch: torch.autocast("cpu", dtype=torch.bfloat16)
    )
    half = train(tiny(shapes, tmp_path / "half"), SETTINGS, stop_after=3)
    assert half.losses != exact.losses
    assert half.losses == pytest.approx(exact.losses, rel=0.1)
    assert all(value.dtype == torch.float32 for value in weights(half.checkpoint).values() if value.is_floating_point())


def test_a_run_that_was_cut_off_ends_as_if_it_had_not_been(shapes: Path, tmp_path: Path) -> None:
    options = tiny(shapes, tmp_path / "whole", epochs=(1, 0, 1), rates=(1e-3, 1e-3, 1e-3))
    whole = train(options, SETTINGS)
    part = replace(options, output=tmp_path / "part")
    for stop in (2, 3, 4):  # in the middle of the first stage, at its end, in the middle of the second
        torch.manual_seed(stop)  # a new process begins with other random numbers
        train(part, SETTINGS, resume=stop > 2, stop_after=stop)
    done = train(part, SETTINGS, resume=True)
    assert done.steps == whole.steps == 6
    expected, found = weights(whole.checkpoint), weights(done.checkpoint)
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert whole.curves.read_text().count("\n") == done.curves.read_text().count("\n") == 7


@pytest.mark.parametrize(("stage", "learning"), [(0, {"heads"}), (1, {"heads", "fpn"}), (2, {"heads", "fpn", "body"})])
def test_a_stage_changes_its_layers_and_no_others(shapes: Path, tmp_path: Path, stage: int, learning: set[str]) -> None:
    epochs = tuple(int(k == stage) for k in range(3))
    options = tiny(shapes, tmp_path, epochs=epochs)
    network, _ = first_network(options, ("background", *CLASSES), SETTINGS)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    done = train(options, SETTINGS, stop_after=1)
    after = weights(done.checkpoint)
    changed = {part_of(name) for name in before if not torch.equal(before[name], after[name])}
    assert changed == learning
    parameters = {name for name, _ in network.named_parameters()}
    same = [n for n in parameters if part_of(n) in learning and torch.equal(before[n], after[n])]
    assert not same


def test_stages_of_the_paper() -> None:
    stages = make_stages((4, 4, 8), (0.001, 0.001, 0.0001))
    assert [(s.name, s.rate) for s in stages] == [("heads", 1e-3), ("fpn and heads", 1e-3), ("all layers", 1e-4)]
    assert make_stages((0, 0, 1), (1, 1, 1)) == (Stage("all layers", ("heads", "fpn", "body"), 1, 1),)


def test_rate_starts_small_and_falls_when_told() -> None:
    stage = Stage("heads", ("heads",), 1, 0.1)
    rates = [rate_at(stage, step, 100, decay=True) for step in range(100)]
    assert rates[0] == pytest.approx(0.01)
    assert max(rates) == rates[10] == pytest.approx(0.1)
    assert rates[-1] < 0.002
    assert rate_at(stage, 99, 100, decay=False) == 0.1


def test_frozen_statistics_stay(shapes: Path, tmp_path: Path) -> None:
    network, _ = first_network(tiny(shapes, tmp_path), ("background", *CLASSES), SETTINGS)
    enter(network, Stage("heads", ("heads",), 1, 0.1))
    assert not network.backbone.body.bn1.training
    enter(network, Stage("all layers", ("heads", "fpn", "body"), 1, 0.1))
    assert network.backbone.body.bn1.training


def test_classes_of_the_same_name_are_kept(shapes: Path, tmp_path: Path) -> None:
    options = tiny(shapes, tmp_path)
    source, _ = first_network(options, ("background", "disc", "cup", "square"), SETTINGS)
    target, _ = first_network(replace(options, seed=5), ("background", "square", "lamp"), SETTINGS)
    before = target.roi_heads.box_predictor.cls_score.weight.clone()
    known = ("__background__", "disc", "cup", "square")
    adopt(target, source.state_dict(), ("background", "square", "lamp"), known, torch)
    old, new = source.roi_heads.box_predictor, target.roi_heads.box_predictor
    assert torch.equal(new.cls_score.weight[:2], old.cls_score.weight[[0, 3]])
    assert torch.equal(new.cls_score.weight[2], before[2])
    assert torch.equal(new.bbox_pred.weight[4:8], old.bbox_pred.weight[12:16])
    assert torch.equal(target.backbone.body.conv1.weight, source.backbone.body.conv1.weight)


def test_wrong_data_and_options_are_named(shapes: Path, tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"instances_val\.json is not there.*splits in it: train"):
        load_coco(shapes, "val")
    with pytest.raises(TrainingError, match=r"has no class lamp; it has disc, square"):
        load_coco(shapes, "train", ["lamp"])
    with pytest.raises(UsageError, match="--backbone vgg"):
        tiny(shapes, tmp_path, backbone="vgg")
    with pytest.raises(UsageError, match="not all 0"):
        tiny(shapes, tmp_path, epochs=(0, 0, 0))
    with pytest.raises(UsageError, match=r"detector\.pth is not there, so there is nothing to go on from"):
        train(tiny(shapes, tmp_path / "new"), SETTINGS, resume=True)
    assert not (tmp_path / "new").exists()
    (tmp_path / CHECKPOINT).touch()
    with pytest.raises(UsageError, match="--resume"):
        train(tiny(shapes, tmp_path), SETTINGS)
    with pytest.raises(ModelError, match=r"detector\.pth cannot be read"):
        train(tiny(shapes, tmp_path), SETTINGS, resume=True)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[]", "not in COCO's format: it is no object with images, annotations and categories"),
        ('{"images": 3}', "it is no object with images, annotations and categories"),
        ('{"images": [{"id": 1}], "annotations": [], "categories": []}', "one of its entries has no 'file_name'"),
        ('{"images": [', "cannot be read as JSON"),
        ('{"images": [], "annotations": [], "categories": []}', "lists no image"),
    ],
)
def test_a_file_that_is_no_coco_is_named(content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / "annotations").mkdir()
    (tmp_path / "train").mkdir()
    (tmp_path / "annotations" / "instances_train.json").write_text(content)
    with pytest.raises(TrainingError, match=r"annotations/instances_train\.json .*" + re.escape(message)):
        load_coco(tmp_path, "train")


def test_a_missing_picture_is_named(shapes: Path) -> None:
    picture = load_coco(shapes, "train").pictures[0]
    with pytest.raises(TrainingError, match=r"gone\.png \(image 1\) is not there or is no image"):
        read_picture(replace(picture, path=shapes / "gone.png"))
    with pytest.raises(TrainingError, match=r"1\.png is 64x48, but its entry says 65x48"):
        read_picture(replace(picture, width=65))


def test_resume_with_other_options_is_refused(shapes: Path, tmp_path: Path) -> None:
    train(tiny(shapes, tmp_path), SETTINGS, stop_after=1)
    with pytest.raises(TrainingError, match="other values of batch, seed"):
        train(tiny(shapes, tmp_path, batch=2, seed=3), SETTINGS, resume=True)
    with pytest.raises(TrainingError, match="classes disc, square, not on square"):
        train(tiny(shapes, tmp_path, classes=("square",)), SETTINGS, resume=True)


def test_masks_in_all_formats_of_coco(shapes: Path) -> None:
    from pycocotools import mask as reference

    data = load_coco(shapes, "train")
    picture = data.pictures[0]
    instance = picture.instances[0]
    exact = mask_of(instance, picture)
    assert (read_picture(picture)[exact] == (220, 30, 30)).all()
    rng = np.random.default_rng(1)
    for density in (0.0, 0.02, 0.5, 1.0):
        mask = rng.random((48, 64)) < density
        np.testing.assert_array_equal(decode_rle(run_lengths(mask), mask.shape), mask)
        packed = reference.encode(np.asfortranarray(mask.astype(np.uint8)))
        text = {"size": [48, 64], "counts": packed["counts"].decode()}
        np.testing.assert_array_equal(mask_of(replace(instance, segmentation=text), picture), mask)
    square = replace(instance, segmentation=[[10, 10, 20, 10, 20, 20, 10, 20]])
    assert mask_of(square, picture)[10:21, 10:21].all()
    assert 100 <= mask_of(square, picture).sum() <= 144
    with pytest.raises(TrainingError, match=r"the mask of annotation 1 is broken"):
        mask_of(replace(instance, segmentation={"size": [48, 64], "counts": [3]}), picture)


class Perfect:
    """Finds what is annotated; `shift` pixels beside it."""

    classes: tuple[str, ...] | None = ("background", *CLASSES)
    info = ModelInfo("detector", "perfect", "")

    def __init__(self, folder: Path, shift: int = 0, drop: str = "") -> None:
        self.data, self.shift, self.drop, self.next = load_coco(folder, "train"), shift, drop, 0

    def detect(self, image: ImageArray, instances: InstanceMasks | None) -> tuple[Detection, ...]:
        picture = self.data.pictures[self.next]
        self.next += 1
        found = []
        for instance in picture.instances:
            x, y, w, h = instance.box
            box = np.array([x + self.shift, y, x + w + self.shift, y + h], dtype=np.float32)
            mask = np.roll(mask_of(instance, picture), self.shift, axis=1)
            found.append(Detection(self.data.classes[instance.label], 0.9, box, mask))
        return tuple(d for d in found if d.category != self.drop)


def test_scores_of_detectors_that_are_known(shapes: Path) -> None:
    data = load_coco(shapes, "train")
    perfect = evaluate_detector(Perfect(shapes), data)
    assert perfect.boxes.values == pytest.approx((1, 1, 1, 1))
    assert perfect.masks.values == pytest.approx((1, 1, 1, 1))
    assert (perfect.images, perfect.objects) == (12, 24)
    beside = evaluate_detector(Perfect(shapes, shift=4), data)  # IoU about 13/21 = 0.62
    assert beside.boxes.ap50 == pytest.approx(1)
    assert beside.boxes.ap75 == pytest.approx(0)
    assert 0.2 <= beside.boxes.ap <= 0.4
    half = evaluate_detector(Perfect(shapes, drop="disc"), data)
    assert half.boxes.ap == pytest.approx(0.5)
    assert half.class_ap50 == pytest.approx({"disc": 0, "square": 1})
    turned = evaluate_detector(Perfect(shapes, drop="disc"), load_coco(shapes, "train", ["square", "disc"]))
    assert turned.class_ap50 == pytest.approx({"disc": 0, "square": 1})
    nothing = evaluate_detector(Perfect(shapes, drop="disc"), load_coco(shapes, "train", ["disc"]))
    assert nothing.boxes.values == nothing.masks.values == (0, 0, 0, 0)


def test_scores_are_those_of_the_evaluator_on_the_file(shapes: Path, tmp_path: Path) -> None:
    """Crowds, polygons, and objects narrower than a pixel: as the evaluator takes them when it reads the file."""
    from pycocotools import mask as rle
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    content = json.loads((shapes / "annotations" / "instances_train.json").read_text())
    rows = content["annotations"]
    for crowd in (rows[0], rows[4]):
        crowd |= {"iscrowd": 1, "segmentation": {"size": [48, 64], "counts": [0, 48 * 64]}, "bbox": [0, 0, 64, 48]}
    rows[3]["segmentation"] = [[38.3, 16.2, 54.1, 16.2, 54.1, 31.7, 38.3, 31.7]]
    rows[5] |= {"bbox": [40, 10, 0.5, 12], "segmentation": [[40, 10, 40.5, 10, 40.5, 22]], "area": 3}
    (tmp_path / "annotations").mkdir()
    (tmp_path / "train").symlink_to(shapes / "train")
    file = tmp_path / "annotations" / "instances_train.json"
    file.write_text(json.dumps(content))
    data = load_coco(tmp_path, "train")
    assert sum(len(picture.instances) for picture in data.pictures) == 21
    found = evaluate_detector(Perfect(shapes, shift=2), data)
    assert found.objects == 22

    truth, seen, results = COCO(str(file)), Perfect(shapes, shift=2), []
    for picture in data.pictures:
        for d in seen.detect(read_picture(picture), None):
            x0, y0, x1, y1 = map(float, d.box)
            row = {"image_id": picture.image_id, "category_id": 1 + CLASSES.index(d.category), "score": d.score}
            mask = rle.encode(np.asfortranarray(d.mask.astype(np.uint8)))
            results.append({**row, "bbox": [x0, y0, x1 - x0, y1 - y0], "segmentation": mask})
    for kind, scores in (("bbox", found.boxes), ("segm", found.masks)):
        reference = COCOeval(truth, truth.loadRes([dict(row) for row in results]), kind)
        reference.evaluate()
        reference.accumulate()
        reference.summarize()
        assert scores.values == pytest.approx(reference.stats[[0, 1, 2, 8]], abs=1e-12)
        assert 0.3 < scores.ap < 1


def test_commands_train_go_on_and_print_table_2(shapes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SEMDB_THREADS", "1")
    data, output = ("--coco", str(shapes), "--classes", "disc,square"), str(tmp_path / "out")
    recipe = ("--weights", "none", "--backbone", "resnet18", "--min-size", "48", "--max-size", "64", "--anchor", "8")
    small = ("--channels", "16", "--batch", "6", "--rois", "16", "--device", "cpu", "--epochs", "1,1,1")
    command = ["train", "detector", *data, "--output", output, *recipe, *small]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("6 steps, loss ")
    rows = list(csv.DictReader((tmp_path / "out" / "curves.csv").open()))
    assert [row["stage"] for row in rows] == ["heads"] * 2 + ["fpn and heads"] * 2 + ["all layers"] * 2
    assert CliRunner().invoke(app, command).exit_code == 2
    assert CliRunner().invoke(app, [*command, "--resume"]).stdout.startswith("6 steps")
    spec, scores = f"torchvision:{output}/{CHECKPOINT}", tmp_path / "scores.json"
    done = CliRunner().invoke(app, ["evaluate-detector", spec, *data, "--split", "train", "--json", str(scores)])
    assert done.exit_code == 0, done.output
    lines = [line.split() for line in done.stdout.splitlines()]
    assert lines[1] == ["AP", "AP50", "AP75", "AR"]
    table = {
        " ".join(line[:-4]): line[-4:]
        for line in lines[2:]
        if line and line[0] in ("boxes", "boxes,", "masks", "masks,")
    }
    assert table["boxes, paper on COCO minival"] == ["0.354", "0.546", "0.385", "0.437"]
    assert table["masks, paper on COCO minival"] == ["0.305", "0.513", "0.318", "0.384"]
    kept = json.loads(scores.read_text())
    for kind in ("boxes", "masks"):
        assert table[kind] == [f"{kept[kind][name]:.3f}" for name in ("ap", "ap50", "ap75", "ar")]


def test_masks_of_a_recording_are_not_measured(shapes: Path) -> None:
    with pytest.raises(UsageError, match="recorded takes masks that come with a recording"):
        evaluate_detector(load_detector("recorded", SETTINGS), load_coco(shapes, "train"))


def test_the_papers_table() -> None:
    assert PAPER.boxes.values == (0.354, 0.546, 0.385, 0.437)
    assert PAPER.masks.values == (0.305, 0.513, 0.318, 0.384)
