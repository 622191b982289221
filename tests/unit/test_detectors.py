from __future__ import annotations

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.errors import FrameError, ModelError, UsageError
from semdb.perception.detectors import load_detector
from semdb.perception.detectors.coco import COCO_91
from semdb.settings import Settings
from semdb.types import InstanceMasks
from tests.unit.onnx_files import write_constant_model, write_mean_embedding_model, write_mean_score_model

HEIGHT, WIDTH = 24, 32
BOXES = np.array([[1, 2, 10, 12], [-3, 0, 50, 23.4], [5, 5, 8, 8]], dtype=np.float32)


def settings(threshold: float = 0.5, **more: object) -> Settings:
    return Settings(score_threshold=threshold, threads=1, **more)  # type: ignore[arg-type]


def colour(red: int, green: int, blue: int) -> np.ndarray:
    return np.full((HEIGHT, WIDTH, 3), (red, green, blue), dtype=np.uint8)


def square_masks() -> np.ndarray:
    masks = np.zeros((3, 1, HEIGHT, WIDTH), dtype=np.float32)
    for k in range(3):
        masks[k, 0, 2:6, 3 + k : 9] = 0.5  # exactly the threshold: inside
        masks[k, 0, 6:9, 3:9] = 0.49
    return masks


def three(path: Path, labels: list[int], masks: np.ndarray | None = None, classes: str | None = None) -> str:
    metadata = None if classes is None else {"classes": classes}
    masks = square_masks() if masks is None else masks
    write_mean_score_model(path / "three.onnx", BOXES, np.array(labels, dtype=np.int64), masks, metadata)
    return f"onnx:{path / 'three.onnx'}"


def test_onnx_takes_rgb_from_0_to_1_and_sorts_by_score(tmp_path: Path) -> None:
    detector = load_detector(three(tmp_path, [62, 67, 47]), settings())
    found = detector.detect(colour(153, 51, 255), None)
    # red 0.6 is the first object's score, green 0.2 (below the threshold) the second's, blue 1.0 the third's
    assert [(d.category, d.weak) for d in found] == [("cup", False), ("chair", False), ("dining table", True)]
    assert [d.score for d in found] == pytest.approx([1.0, 0.6, 0.2], abs=1e-6)
    assert found[2].mask.shape == (0, 0)


def test_onnx_drops_what_it_hardly_saw(tmp_path: Path) -> None:
    detector = load_detector(three(tmp_path, [62, 67, 47]), settings(0.9))
    found = detector.detect(colour(12, 13, 255), None)  # 0.047, 0.051
    assert [(d.category, d.weak) for d in found] == [("cup", False), ("dining table", True)]


def test_onnx_boxes_stay_inside_and_masks_are_cut_at_one_half(tmp_path: Path) -> None:
    detector = load_detector(three(tmp_path, [62, 67, 47]), settings(0.1))
    found = {d.category: d for d in detector.detect(colour(255, 128, 64), None)}
    np.testing.assert_array_equal(found["dining table"].box, [0, 0, WIDTH - 1, HEIGHT - 1])
    assert found["chair"].mask.dtype == np.bool_
    assert [int(found[name].mask.sum()) for name in ("chair", "dining table", "cup")] == [24, 20, 16]


def test_onnx_drops_labels_without_object_and_empty_masks(tmp_path: Path) -> None:
    masks = square_masks()
    masks[1] = 0.3
    detector = load_detector(three(tmp_path, [12, 67, 47], masks), settings(0.1))
    assert COCO_91[12] == "N/A"
    assert [d.category for d in detector.detect(colour(255, 255, 255), None)] == ["cup"]


def test_onnx_keeps_a_score_at_the_threshold(tmp_path: Path) -> None:
    spec = three(tmp_path, [62, 67, 47])
    image = colour(255, 255, 0)
    assert len(load_detector(spec, settings(1.0)).detect(image, None)) == 2
    assert len(load_detector(spec, settings(0.0)).detect(image, None)) == 3


def test_onnx_class_names_come_from_the_file(tmp_path: Path) -> None:
    detector = load_detector(three(tmp_path, [1, 0, 1], classes='["N/A", "robot"]'), settings(0.1))
    assert [d.category for d in detector.detect(colour(255, 255, 128), None)] == ["robot", "robot"]


def test_onnx_label_without_name_is_an_error(tmp_path: Path) -> None:
    detector = load_detector(three(tmp_path, [1, 0, 2], classes='["N/A", "robot"]'), settings(0.1))
    with pytest.raises(ModelError, match=r"three\.onnx gave label 2 but has 2 class names"):
        detector.detect(colour(255, 255, 255), None)


@pytest.mark.parametrize("classes", ["not json", '{"a": 1}', "[]", "[1, 2]"])
def test_onnx_bad_class_list_is_an_error(tmp_path: Path, classes: str) -> None:
    with pytest.raises(ModelError, match=r"three\.onnx.*must be a JSON list of names"):
        load_detector(three(tmp_path, [1, 1, 1], classes=classes), settings())


def test_onnx_masks_of_another_size_are_an_error(tmp_path: Path) -> None:
    masks = np.ones((3, 1, 28, 28), dtype=np.float32)
    detector = load_detector(three(tmp_path, [1, 1, 1], masks), settings())
    with pytest.raises(ModelError, match=r"32x24 .* masks \(3, 1, 28, 28\)"):
        detector.detect(colour(255, 255, 255), None)


def test_onnx_nothing_found_is_an_empty_tuple(tmp_path: Path) -> None:
    nothing = {
        "boxes": np.zeros((0, 4), np.float32),
        "labels": np.zeros(0, np.int64),
        "scores": np.zeros(0, np.float32),
        "masks": np.zeros((0, 1, HEIGHT, WIDTH), np.float32),
    }
    path = write_constant_model(tmp_path / "nothing.onnx", nothing)
    assert load_detector(f"onnx:{path}", settings()).detect(colour(0, 0, 0), None) == ()


def test_onnx_info_names_the_file_without_its_folder(tmp_path: Path) -> None:
    spec = three(tmp_path, [62, 67, 47])
    info = load_detector(spec, settings(0.5)).info
    assert (info.role, info.name) == ("detector", "onnx:three.onnx")
    assert info.sha256 == hashlib.sha256((tmp_path / "three.onnx").read_bytes()).hexdigest()
    assert json.loads(info.config) == {"mask_threshold": 0.5, "score_threshold": 0.5, "weak_threshold": 0.05}
    assert load_detector(spec, Settings(score_threshold=0.5, threads=2)).info == info
    assert load_detector(spec, settings(0.6)).info != info


def test_hash_follows_the_file(tmp_path: Path) -> None:
    first = load_detector(three(tmp_path, [62, 67, 47]), settings()).info.sha256
    second = load_detector(three(tmp_path, [62, 67, 47], classes='["a"]'), settings()).info.sha256
    assert first != second
    assert second == hashlib.sha256((tmp_path / "three.onnx").read_bytes()).hexdigest()


def test_bare_name_is_found_in_the_models_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cache" / "models").mkdir(parents=True)
    three(tmp_path / "cache" / "models", [62, 67, 47])
    monkeypatch.chdir(tmp_path)
    detector = load_detector("onnx:three.onnx", settings(cache_dir=tmp_path / "cache"))
    assert detector.info.name == "onnx:three.onnx"


def test_home_is_expanded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    three(tmp_path, [62, 67, 47])
    assert load_detector("onnx:~/three.onnx", settings()).info.name == "onnx:three.onnx"


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"no model file at .*/gone\.onnx .*check the path"):
        load_detector(f"onnx:{tmp_path}/gone.onnx", settings())


@pytest.mark.parametrize(("spec", "message"), [("onnx:", "names no file"), ("onnx:{}", "is a folder")])
def test_spec_without_file(tmp_path: Path, spec: str, message: str) -> None:
    with pytest.raises(ModelError, match=message):
        load_detector(spec.format(tmp_path), settings())


@pytest.mark.parametrize("content", [b"", b"these are words, no network\n" * 20, bytes(range(256)) * 8])
def test_file_that_is_no_model(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "bad.onnx").write_bytes(content)
    with pytest.raises(ModelError, match=r"bad\.onnx (cannot be opened as an ONNX model|has no output)"):
        load_detector(f"onnx:{tmp_path}/bad.onnx", settings())


def test_truncated_model(tmp_path: Path, shared_dir: Path) -> None:
    whole = (shared_dir / "models" / "mask_rcnn_2go.onnx").read_bytes()
    (tmp_path / "half.onnx").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ModelError, match=r"half\.onnx cannot be opened as an ONNX model"):
        load_detector(f"onnx:{tmp_path}/half.onnx", settings())


def test_encoder_file_is_no_detector(tmp_path: Path) -> None:
    path = write_mean_embedding_model(tmp_path / "encoder.onnx")
    with pytest.raises(
        ModelError, match=r"encoder\.onnx has no output boxes, labels, scores, masks \(it has embedding\)"
    ):
        load_detector(f"onnx:{path}", settings())


@pytest.mark.parametrize("spec", ["", "auto", "yolo", "three.onnx"])
def test_unknown_spec(spec: str) -> None:
    with pytest.raises(UsageError, match=r"no detector .* write onnx:FILE"):
        load_detector(spec, settings())


def test_coco_names() -> None:
    assert len(COCO_91) == 91
    assert len(set(COCO_91) - {"N/A", "background"}) == 80
    named = {
        1: "person",
        44: "bottle",
        47: "cup",
        62: "chair",
        67: "dining table",
        72: "tv",
        84: "book",
        90: "toothbrush",
    }
    assert {label: COCO_91[label] for label in named} == named


def test_coco_names_agree_with_a_real_file(shared_dir: Path) -> None:
    import onnxruntime as ort

    session = ort.InferenceSession(shared_dir / "models" / "mask_rcnn_2go.onnx", providers=["CPUExecutionProvider"])
    names = json.loads(session.get_modelmeta().custom_metadata_map["classes"])
    assert tuple(names[1:]) == COCO_91[1:]


@pytest.mark.shared
def test_real_mask_rcnn_on_real_frames(shared_dir: Path) -> None:
    detector = load_detector(f"onnx:{shared_dir}/models/mask_rcnn_2go.onnx", settings(0.75))
    scene = shared_dir / "recordings" / "7scenes_redkitchen" / "seq-01"
    image = cv2.imread(str(scene / "frame-000000.color.jpg"))[..., ::-1].copy()
    everything = detector.detect(image, None)
    found = [detection for detection in everything if not detection.weak]
    assert len(everything) > 3 * len(found)
    assert min(detection.score for detection in everything) >= 0.05
    assert [d.category for d in found] == ["chair", "dining table", "chair"]
    assert [d.score for d in found] == pytest.approx([0.97, 0.96, 0.91], abs=0.006)
    for detection in found:
        v, u = np.nonzero(detection.mask)
        assert u.min() >= detection.box[0] - 1
        assert v.min() >= detection.box[1] - 1
        assert u.max() <= detection.box[2] + 1
        assert v.max() <= detection.box[3] + 1
        assert len(u) > 4000
    assert detector.detect(np.zeros_like(image), None) == ()


def instances(labels: np.ndarray, **names: int) -> InstanceMasks:
    return InstanceMasks(labels.astype(np.uint16), {number: name for name, number in names.items()})


def test_recorded_gives_tight_boxes_in_order_of_labels() -> None:
    labels = np.zeros((HEIGHT, WIDTH))
    labels[4:14, 2:12] = 9
    labels[0:8, 20:32] = 3
    found = load_detector("recorded", settings()).detect(colour(0, 0, 0), instances(labels, cup=9, laptop=3))
    assert [(d.category, d.score, d.box.tolist(), int(d.mask.sum())) for d in found] == [
        ("laptop", 1.0, [20, 0, 31, 7], 96),
        ("cup", 1.0, [2, 4, 11, 13], 100),
    ]
    np.testing.assert_array_equal(found[1].mask, labels == 9)


def test_recorded_drops_what_is_smaller_than_64_pixels() -> None:
    labels = np.zeros((HEIGHT, WIDTH))
    labels[0:8, 0:8] = 1
    labels[10:17, 0:9] = 2  # 63 pixels
    found = load_detector("recorded", settings()).detect(colour(0, 0, 0), instances(labels, cup=1, book=2))
    assert [d.category for d in found] == ["cup"]


def test_recorded_without_masks_says_what_to_do() -> None:
    with pytest.raises(UsageError, match=r"brings no masks.*SEMDB_DETECTOR=onnx:FILE"):
        load_detector("recorded", settings()).detect(colour(0, 0, 0), None)


def test_recorded_masks_must_fit_and_have_names() -> None:
    detector = load_detector("recorded", settings())
    with pytest.raises(FrameError, match=r"masks of 8x6 do not fit an image of 32x24"):
        detector.detect(colour(0, 0, 0), instances(np.zeros((6, 8))))
    with pytest.raises(FrameError, match=r"label 7 in the masks has no class name"):
        detector.detect(colour(0, 0, 0), instances(np.full((HEIGHT, WIDTH), 7), cup=1))
