"""ResNet place vectors in torch: the Places365 network of the paper, torchvision's ImageNet one, or a checkpoint."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from semdb.errors import ModelError
from semdb.perception.catalogue import BY_NAME
from semdb.perception.encoders.crops import config_of, crop_named, square
from semdb.perception.encoders.onnx import unit_vector
from semdb.perception.model_files import canonical_json, file_sha256, first_line
from semdb.perception.torch_models import (
    best_batch,
    import_torch,
    layer_precision,
    load_weights,
    prepare,
    read_checkpoint,
    resolve_checkpoint,
    state_dict_of,
    to_device,
)
from semdb.settings import Settings
from semdb.types import Float32Array, ImageArray, ModelInfo

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # RGB of ImageNet, which both networks were trained with
_LAYERS: dict[tuple[str, tuple[int, ...]], str] = {
    ("bottleneck", (3, 4, 6, 3)): "resnet50",
    ("bottleneck", (3, 4, 23, 3)): "resnet101",
    ("bottleneck", (3, 8, 36, 3)): "resnet152",
    ("basic", (2, 2, 2, 2)): "resnet18",
    ("basic", (3, 4, 6, 3)): "resnet34",
}


class TorchvisionEncoder:
    """A ResNet up to its average pool (2048-d for ResNet-50) on a square of the image, in torch."""

    def __init__(self, spec: str, settings: Settings) -> None:
        self._torch = import_torch()
        path = resolve_checkpoint(spec, settings)
        name = spec.removeprefix("torchvision:")
        network = load_encoder_checkpoint(path, expected_outputs(spec))
        self._network = prepare(network, settings, self._torch)
        self._device = next(self._network.parameters()).device
        self.best_batch = best_batch(self._device)
        self._path = path
        self._crop = crop_named(settings.encoder_crop)
        config = canonical_json({**config_of(self._crop), "layer": "avgpool"})
        shown = name if name in BY_NAME else path.name
        self.info = ModelInfo("encoder", f"torchvision:{shown}", file_sha256(path), config)

    def encode(self, image: ImageArray) -> Float32Array:
        """The L2-normalised vector float32 ``[d]`` of an RGB `image` ``[H, W, 3]``.

        Raises ModelError when the network fails, or its vector is zero or not finite.
        """
        vector: Float32Array = self.encode_batch([image])[0]
        return vector

    def encode_batch(self, images: Sequence[ImageArray]) -> Float32Array:
        """The vectors of `images` (of any sizes) float32 ``[n, d]``; each as `encode` gives it, within rounding."""
        torch = self._torch
        shown = np.concatenate([square(image, self._crop) for image in images])
        batch = to_device(shown, self._device, torch)
        try:
            with torch.inference_mode(), layer_precision(self._device, torch):
                found = self._network(batch).float().cpu().numpy()
        except RuntimeError as error:
            raise ModelError(
                f"{self._path} failed on {len(images)} images on {self._device}: {first_line(error)}"
            ) from error
        return np.stack([unit_vector(row, self._path) for row in found])


def expected_outputs(spec: str) -> int | None:
    """The number of classes that the file of a published ``torchvision:NAME`` must have; None for a path."""
    return {"resnet50-places365": 365, "resnet50": 1000}.get(spec.removeprefix("torchvision:"))


def load_encoder_checkpoint(path: Path, outputs: int | None = None) -> Any:
    """The network from ``[B, 3, 224, 224]`` RGB 0..1 to the average pool ``[B, d]`` of a ResNet checkpoint.

    `outputs` is the number of classes that it must have. Raises ModelError when it is no ResNet of torchvision's.
    """
    tensors = state_dict_of(read_checkpoint(path), path)
    kind = "bottleneck" if "layer1.0.conv3.weight" in tensors else "basic"
    blocks = tuple(
        len({m[1] for name in tensors if (m := re.match(rf"layer{layer}\.(\d+)\.", name))}) for layer in (1, 2, 3, 4)
    )
    name = _LAYERS.get((kind, blocks))
    if name is None or "fc.weight" not in tensors:
        raise ModelError(f"{path} is no checkpoint of torchvision's ResNet: it has no fc.weight, or other layers")
    classes = int(tensors["fc.weight"].shape[0])
    if outputs is not None and classes != outputs:
        raise ModelError(f"{path} has {classes} outputs, but should have {outputs}: it is another network")
    return build_encoder(name, classes, tensors, path)


def build_encoder(name: str, classes: int, tensors: Mapping[str, Any], path: Path) -> Any:
    """The ResNet `name` of torchvision with `tensors`, without its last layer; colours are normalised inside.

    Raises ModelError when the weights do not fit.
    """
    torch = import_torch()
    import torchvision

    network = getattr(torchvision.models, name)(weights=None, num_classes=classes)
    load_weights(network, tensors, path, name)
    network.fc = torch.nn.Identity()
    colours = torchvision.ops.FrozenBatchNorm2d(3, eps=0.0)  # (image - mean) / deviation
    colours.running_mean.copy_(torch.tensor(MEAN))
    colours.running_var.copy_(torch.tensor(DEVIATION) ** 2)
    return torch.nn.Sequential(colours, network).eval()
