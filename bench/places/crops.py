"""What a network is shown of an image, as squares of 224 pixels, and how its outputs become one vector."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from semdb.types import Float32Array, ImageArray

SIDE = 224
POWER = 3.0  # of the generalised mean

Crop = Callable[[ImageArray], ImageArray]


def _short_side(image: ImageArray, side: int) -> ImageArray:
    ratio = side / min(image.shape[:2])
    size = (max(side, round(image.shape[1] * ratio)), max(side, round(image.shape[0] * ratio)))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _square(image: ImageArray, along: float) -> ImageArray:
    """The square of an image whose short side is 224, at a share `along` of the room that its long side leaves."""
    y, x = (round(along * (n - SIDE)) for n in image.shape[:2])
    return image[y : y + SIDE, x : x + SIDE]


def _centre(image: ImageArray) -> ImageArray:
    large = _short_side(image, 256)
    y, x = large.shape[0] // 2 - SIDE // 2, large.shape[1] // 2 - SIDE // 2
    return large[y : y + SIDE, x : x + SIDE]


def _padded(image: ImageArray) -> ImageArray:
    ratio = SIDE / max(image.shape[:2])
    small = cv2.resize(
        image, (round(image.shape[1] * ratio), round(image.shape[0] * ratio)), interpolation=cv2.INTER_AREA
    )
    out = np.full((SIDE, SIDE, 3), 124, np.uint8)
    y, x = (SIDE - small.shape[0]) // 2, (SIDE - small.shape[1]) // 2
    out[y : y + small.shape[0], x : x + small.shape[1]] = small
    return out


def _squashed(image: ImageArray) -> ImageArray:
    return np.asarray(cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


CROPS: dict[str, Crop] = {
    "centre": _centre,
    "height": lambda image: _square(_short_side(image, SIDE), 0.5),
    "padded": _padded,
    "squashed": _squashed,
    "first": lambda image: _square(_short_side(image, SIDE), 0.0),
    "last": lambda image: _square(_short_side(image, SIDE), 1.0),
}
# Whose vectors are pooled: the mean of unit vectors. `+flip` adds each one's mirror image.
VIEWS: dict[str, tuple[str, ...]] = {
    "centre": ("centre",),
    "height": ("height",),
    "padded": ("padded",),
    "squashed": ("squashed",),
    "two squares": ("first", "last"),
    "three squares": ("first", "height", "last"),
}


def unit(vectors: Float32Array) -> Float32Array:
    """Rows at length 1."""
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12), np.float32)


class Network:
    """An ONNX encoder that also gives its last map, where one feeds the pooling that makes the embedding."""

    def __init__(self, path: Path) -> None:
        import onnx
        import onnxruntime as ort

        model = onnx.load(str(path))
        last = _last_map(model)
        if last is not None:
            model.graph.output.append(onnx.helper.make_tensor_value_info(last, onnx.TensorProto.FLOAT, None))
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        providers = ["CPUExecutionProvider"]
        self._session = ort.InferenceSession(model.SerializeToString(), options, providers=providers)
        self._input = self._session.get_inputs()[0].name
        self._outputs = ["embedding"] + ([] if last is None else [last])
        self.name = path.stem

    def __call__(self, crop: ImageArray) -> dict[str, Float32Array]:
        """``mean``, the embedding, and ``gem``, generalised means of the last map on the grid of the embedding."""
        batch = np.ascontiguousarray(crop.transpose(2, 0, 1)[None], np.float32) / np.float32(255)
        found: list[Any] = self._session.run(self._outputs, {self._input: batch})
        result = {"mean": unit(found[0][0])}
        if len(found) > 1:
            result["gem"] = unit(_generalised(found[1][0], len(found[0][0])))
        return result


def _last_map(model: Any) -> str | None:
    made_by = {name: node for node in model.graph.node for name in node.output}
    node = made_by.get("embedding")
    while node is not None and node.op_type in ("Flatten", "Reshape", "Squeeze"):
        node = made_by.get(node.input[0])
    pools = ("AveragePool", "GlobalAveragePool", "ReduceMean")
    return None if node is None or node.op_type not in pools else str(node.input[0])


def _generalised(last: Float32Array, numbers: int) -> Float32Array:
    """Generalised means of a map ``[c, h, w]`` on the grid that gives `numbers`."""
    grid = max(1, round((numbers / len(last)) ** 0.5))
    powers = np.maximum(last, 1e-6) ** POWER
    rows = np.array_split(np.arange(last.shape[1]), grid)
    columns = np.array_split(np.arange(last.shape[2]), grid)
    cells = [powers[:, r[0] : r[-1] + 1, c[0] : c[-1] + 1].mean(axis=(1, 2)) for r in rows for c in columns]
    return np.asarray(np.stack(cells, axis=1).ravel() ** (1 / POWER), np.float32)


def atoms(network: Network, images: Sequence[ImageArray], tell: Callable[[int], None]) -> dict[str, Any]:
    """Vectors ``[n, d]`` by crop and pooling (``height``, ``height gem``, with ``flip`` before), and ms of a pass."""
    found: dict[str, list[Float32Array]] = {}
    started, passes = time.process_time(), 0
    for number, image in enumerate(images):
        for name, crop in CROPS.items():
            square = np.ascontiguousarray(crop(image))
            for flip in ("", "flip "):
                shown = np.ascontiguousarray(square[:, ::-1]) if flip else square
                for pooling, vector in network(shown).items():
                    found.setdefault(f"{flip}{name} {pooling}", []).append(vector)
                passes += 1
        tell(number + 1)
    took = 1000 * (time.process_time() - started) / max(1, passes)
    return {**{name: np.stack(vectors) for name, vectors in found.items()}, "ms": np.float32(took)}


def pooled(known: Mapping[str, Float32Array], view: str, pooling: str, flip: bool) -> Float32Array | None:
    """Vectors ``[n, d]`` of a view of `VIEWS`; None where the network gives none."""
    names = [f"{mirrored}{crop} {pooling}" for crop in VIEWS[view] for mirrored in (("", "flip ") if flip else ("",))]
    if any(name not in known for name in names):
        return None
    return unit(np.mean([known[name] for name in names], axis=0))


def passes(view: str, flip: bool) -> int:
    """How often the network runs for one image."""
    return len(VIEWS[view]) * (2 if flip else 1)
