"""What of an image a place network is shown, and that vectors know it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.errors import ModelError, UsageError
from semdb.perception.encoders import load_encoder
from semdb.perception.encoders.crops import CROPS, DEFAULT, config_of, crop_of, square
from semdb.perception.model_choice import crop_of_model, older_crop, settings_of_map, spec_for_redescription
from semdb.settings import Settings, settings_with
from semdb.types import ImageArray, ModelInfo
from tests.unit.onnx_files import write_mean_embedding_model


def halves(height: int, width: int) -> ImageArray:
    """Red on the left, blue on the right; above and below an eighth of the height is green."""
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = image[:, width // 2 :, 2] = 200
    image[: height // 8] = image[-height // 8 :] = (0, 200, 0)
    return image


@pytest.mark.parametrize("size", [(480, 640), (640, 480), (240, 320), (100, 99), (3, 500)])
@pytest.mark.parametrize("crop", CROPS)
def test_each_crop_is_a_square_of_224(size: tuple[int, int], crop: str) -> None:
    found = square(halves(*size), crop)
    assert found.shape == (1, 3, 224, 224)
    assert found.dtype == np.float32
    assert found.flags.c_contiguous
    assert 0 <= found.min() <= found.max() <= 200 / 255 + 1e-6


def test_what_each_crop_shows() -> None:
    image = halves(480, 640)

    def shares(crop: str) -> list[float]:
        return [float(x) for x in (square(image, crop) > 0.4).mean(axis=(0, 2, 3))]

    assert shares("centre") == pytest.approx([0.43, 0.14, 0.43], abs=0.01)  # cuts most of the green away
    for crop in ("height", "squashed"):
        assert shares(crop) == pytest.approx([0.375, 0.25, 0.375], abs=0.01)
    padded = square(image, "padded")[0]
    np.testing.assert_array_equal(padded[:, :28], np.float32(124) / np.float32(255))  # 56 rows are beside the image
    assert (padded[:, 28:-28] > 0.5).mean(axis=(1, 2)) == pytest.approx([0.375, 0.25, 0.375], abs=0.01)


def test_the_oldest_crop_is_what_it_was() -> None:
    """Bit for bit, and by the same provenance: vectors of before are compared with those of now."""
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    resized = cv2.resize(image, (341, 256), interpolation=cv2.INTER_AREA)
    expected = resized[16:240, 58:282].transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)
    np.testing.assert_array_equal(square(image, "centre"), expected)
    assert json.dumps(config_of("centre"), sort_keys=True) == '{"crop": 224, "short_side": 256}'


def test_the_crop_is_part_of_the_provenance(tmp_path: Path) -> None:
    spec = f"onnx:{write_mean_embedding_model(tmp_path / 'mean.onnx')}"
    infos = {crop: load_encoder(spec, Settings(threads=1, encoder_crop=crop)).info for crop in CROPS}
    assert len({info.config for info in infos.values()}) == len(CROPS)
    assert load_encoder(spec, Settings(threads=1)).info == infos[DEFAULT]
    for crop, info in infos.items():
        assert crop_of_model(info) == crop
        assert crop_of(json.loads(info.config)) == crop
        assert settings_of_map(Settings(), [info]).encoder_crop == crop
        own = Settings(encoder_crop="padded")
        assert settings_of_map(own, [info]).encoder_crop == "padded"  # and comparing the models says so
        assert older_crop([info]) == (None if crop == DEFAULT else (crop, DEFAULT))
        assert spec_for_redescription(Settings(encoder=spec), info)[1].encoder_crop == "auto"
    gist = load_encoder("gist", Settings()).info
    assert crop_of_model(gist) is None
    assert older_crop([gist]) is older_crop([]) is None
    assert settings_of_map(Settings(), [gist]).encoder_crop == "auto"


def test_what_makes_no_sense_is_said() -> None:
    with pytest.raises(UsageError, match="encoder_crop=middle"):
        settings_with({"encoder_crop": "middle"})
    newer = ModelInfo("encoder", "onnx:a.onnx", "ab" * 32, '{"crop":224,"view":"fisheye"}')
    with pytest.raises(ModelError, match='has an impossible view: "fisheye"'):
        settings_of_map(Settings(), [newer])
