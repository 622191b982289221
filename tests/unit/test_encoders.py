from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.errors import ModelError, UsageError
from semdb.perception.encoders import load_encoder
from semdb.perception.encoders.gist import GistEncoder
from semdb.perception.protocols import BatchEncoder
from semdb.settings import Settings
from tests.unit.onnx_files import write_constant_model, write_mean_embedding_model

SETTINGS = Settings(threads=1)


def noise(seed: int, height: int = 120, width: int = 160) -> np.ndarray:
    """A random image with structure of all sizes."""
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width, 3), dtype=np.float32)
    for cells in (3, 6, 12, 24, 48):
        coarse = rng.uniform(0, 1, (cells, cells, 3)).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    return (total / 5 * 255).astype(np.uint8)


def red_kitchen(shared_dir: Path, step: int) -> tuple[list[np.ndarray], np.ndarray]:
    paths = sorted((shared_dir / "recordings" / "7scenes_redkitchen" / "seq-01").glob("*.color.jpg"))[::step]
    images = [cv2.imread(str(path))[..., ::-1].copy() for path in paths]
    poses = np.stack([np.loadtxt(str(path).replace(".color.jpg", ".pose.txt")) for path in paths])
    return images, poses


def test_onnx_takes_rgb_and_normalises(tmp_path: Path) -> None:
    path = write_mean_embedding_model(tmp_path / "mean.onnx")
    encoder = load_encoder(f"onnx:{path}", SETTINGS)
    vector = encoder.encode(np.full((48, 64, 3), (30, 0, 40), dtype=np.uint8))
    assert vector.dtype == np.float32
    np.testing.assert_allclose(vector, [0.6, 0.0, 0.8], atol=1e-4)


@pytest.mark.parametrize("size", [(256, 256), (256, 400), (300, 256)])
def test_onnx_sees_the_centre_only(tmp_path: Path, size: tuple[int, int]) -> None:
    encoder = load_encoder(f"onnx:{write_mean_embedding_model(tmp_path / 'mean.onnx')}", SETTINGS)
    image = np.full((*size, 3), (0, 255, 0), dtype=np.uint8)
    y, x = size[0] // 2 - 112, size[1] // 2 - 112
    image[y : y + 224, x : x + 224] = (200, 0, 0)
    np.testing.assert_allclose(encoder.encode(image), [1, 0, 0], atol=1e-6)
    image[y, x : x + 224] = (0, 255, 0)  # the first row inside
    assert encoder.encode(image)[1] > 0.005


def test_onnx_resizes_the_short_side(tmp_path: Path) -> None:
    encoder = load_encoder(f"onnx:{write_mean_embedding_model(tmp_path / 'mean.onnx')}", SETTINGS)
    image = np.full((512, 640, 3), (0, 255, 0), dtype=np.uint8)
    image[32:480, 96:544] = (200, 0, 0)  # twice the crop
    np.testing.assert_allclose(encoder.encode(image), [1, 0, 0], atol=1e-6)
    assert np.linalg.norm(encoder.encode(np.full((3, 5, 3), 90, dtype=np.uint8))) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize(
    ("embedding", "message"),
    [
        (np.array([[1, np.nan]], np.float32), "zero or not finite"),
        (np.array([[1, np.inf]], np.float32), "zero or not finite"),
        (np.zeros((1, 4), np.float32), "zero or not finite"),
        (np.ones((2, 4), np.float32), r"is \(2, 4\) for one image"),
        (np.ones((1, 4, 1, 1), np.float32), r"is \(1, 4, 1, 1\) for one image"),
    ],
)
def test_onnx_bad_embedding_is_an_error(tmp_path: Path, embedding: np.ndarray, message: str) -> None:
    path = write_constant_model(tmp_path / "bad.onnx", {"embedding": embedding})
    with pytest.raises(ModelError, match=message):
        load_encoder(f"onnx:{path}", SETTINGS).encode(noise(0))


def test_onnx_without_embedding_is_no_encoder(tmp_path: Path) -> None:
    path = write_constant_model(tmp_path / "logits.onnx", {"logits": np.ones((1, 4), np.float32)})
    with pytest.raises(ModelError, match=r"logits\.onnx has no output embedding \(it has logits\)"):
        load_encoder(f"onnx:{path}", SETTINGS)


def test_specs() -> None:
    with pytest.raises(UsageError, match=r"no encoder 'auto'"):
        load_encoder("auto", SETTINGS)
    with pytest.raises(ModelError, match=r"no model file at /nowhere/x\.onnx"):
        load_encoder("onnx:/nowhere/x.onnx", SETTINGS)


@pytest.mark.shared
def test_real_places_network(shared_dir: Path) -> None:
    path = shared_dir / "models" / "squeezenet_places365.onnx"
    encoder = load_encoder(f"onnx:{path}", SETTINGS)
    assert encoder.info.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    images, _ = red_kitchen(shared_dir, 40)
    vectors = np.stack([encoder.encode(image) for image in images[:3]])
    assert vectors.shape == (3, 2048)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-6)
    again = encoder.encode(images[0])
    np.testing.assert_array_equal(again, vectors[0])
    assert vectors[0] @ vectors[1] < 0.95


def test_gist_is_a_unit_vector_of_fixed_length_for_any_size() -> None:
    encoder = load_encoder("gist", SETTINGS)
    for height, width in ((480, 640), (1, 1), (37, 500)):
        vector = encoder.encode(noise(1, height, width))
        assert vector.shape == (560,)
        assert vector.dtype == np.float32
        assert np.linalg.norm(vector) == pytest.approx(1, abs=1e-6)


def test_gist_of_a_plain_image_is_finite() -> None:
    encoder = GistEncoder()
    for value in (0, 128, 255):
        vector = encoder.encode(np.full((60, 80, 3), value, dtype=np.uint8))
        np.testing.assert_allclose(vector, 1 / np.sqrt(560), rtol=1e-5)


def test_gist_info_has_no_file() -> None:
    first, second = GistEncoder().info, GistEncoder().info
    assert (first.role, first.name, first.sha256) == ("encoder", "gist", "")
    assert first == second


def test_gist_tells_images_apart() -> None:
    encoder = GistEncoder()
    vectors = np.stack([encoder.encode(noise(seed)) for seed in range(12)])
    between = (vectors @ vectors.T)[np.triu_indices(12, 1)]
    assert abs(between.mean()) < 0.2
    assert between.max() < 0.6


def test_gist_stands_lighting_and_a_small_shift() -> None:
    encoder = GistEncoder()
    image = noise(3, 480, 640)
    vector = encoder.encode(image)
    darker = np.clip(image.astype(np.float32) * 0.6 + 12, 0, 255).astype(np.uint8)
    assert vector @ encoder.encode(darker) > 0.97
    moved = np.roll(image, 12, axis=1)
    assert vector @ encoder.encode(moved) > 0.85


def test_gist_finds_orientation_scale_and_place() -> None:
    """A grating in one quarter of the image excites the filter of its direction and frequency, in that quarter."""
    encoder = GistEncoder()
    x = np.arange(128)
    for axis, orientation in ((1, 0), (0, 4)):
        for scale in range(3):
            wave = 127 + 100 * np.cos(2 * np.pi * 0.3 / 1.85**scale * x)
            grating = np.broadcast_to(wave, (128, 128)) if axis == 1 else np.broadcast_to(wave[:, None], (128, 128))
            image = np.full((128, 128), 127.0)
            image[64:, 64:] = grating[64:, 64:]
            vector = encoder.encode(np.repeat(image.astype(np.uint8)[..., None], 3, axis=2))
            energies = vector[:512].reshape(4, 8, 4, 4)[scale]
            assert np.unravel_index(energies.argmax(), energies.shape)[0] == orientation
            assert energies[orientation, 2:, 2:].mean() > 5 * np.abs(energies[orientation, :2, :2]).mean()


@pytest.mark.shared
def test_gist_retrieves_places(shared_dir: Path) -> None:
    """With every tenth frame as keyframe, the best one is nearly as near in pose as the nearest keyframe."""
    encoder = GistEncoder()
    images, poses = red_kitchen(shared_dir, 5)
    vectors = np.stack([encoder.encode(image) for image in images])
    keyframes = np.arange(0, len(images), 2)
    queries = np.arange(1, len(images), 2)
    best = keyframes[np.argmax(vectors[queries] @ vectors[keyframes].T, axis=1)]

    def view_difference(a: int, b: int) -> float:
        cosine = (np.trace(poses[a, :3, :3].T @ poses[b, :3, :3]) - 1) / 2
        angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
        return float(np.linalg.norm(poses[a, :3, 3] - poses[b, :3, 3]) / 0.3 + angle / 15)

    excess = [
        view_difference(q, k) - min(view_difference(q, j) for j in keyframes)
        for q, k in zip(queries, best, strict=True)
    ]
    assert np.mean(np.array(excess) < 1) >= 0.95


def test_several_images_at_once_give_what_each_gives_alone(tmp_path: Path) -> None:
    encoder = load_encoder(f"onnx:{write_mean_embedding_model(tmp_path / 'mean.onnx')}", SETTINGS)
    assert isinstance(encoder, BatchEncoder)
    assert encoder.best_batch == 1  # on a processor it brings nothing
    images = [noise(seed, *size) for seed, size in enumerate([(48, 64), (300, 260), (480, 640)])]
    vectors = encoder.encode_batch(images)
    assert vectors.shape == (3, 3)
    assert vectors.dtype == np.float32
    np.testing.assert_allclose(vectors, [encoder.encode(image) for image in images], atol=1e-6)
    assert np.abs(vectors[0] - vectors[1]).max() > 1e-4


def test_a_network_for_one_image_at_a_time_gets_one_at_a_time(tmp_path: Path) -> None:
    path = write_constant_model(tmp_path / "one.onnx", {"embedding": np.array([[3, 4]], np.float32)}, batch=1)
    encoder = load_encoder(f"onnx:{path}", SETTINGS)
    assert isinstance(encoder, BatchEncoder)
    np.testing.assert_allclose(encoder.encode_batch([noise(0), noise(1)]), [[0.6, 0.8]] * 2, atol=1e-6)
