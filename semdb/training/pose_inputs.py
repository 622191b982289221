"""Images as networks that regress poses get them: pixels, or the last map of a network that does not learn."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError, UsageError
from semdb.perception.model_files import first_line, onnx_providers, onnx_sha256, resolve_onnx
from semdb.perception.torch_models import INSTALL
from semdb.settings import Settings
from semdb.training.pose_options import FROZEN, PoseOptions
from semdb.types import Float32Array, ImageArray, ModelInfo

SIDE = 224
DEPTH_UNIT_M = 4.0
_CELL = 4  # depths on a side of a cell of a frozen map
_POOLS = ("GlobalAveragePool", "AveragePool", "ReduceMean", "GlobalMaxPool", "MaxPool")
_SHAPES = ("Flatten", "Reshape", "Squeeze", "Identity")


class Inputs(Protocol):
    """From an image ``[H, W, 3]`` and its depth to what the network gets ``[C, h, w]``."""

    @property
    def model(self) -> ModelInfo | None: ...

    def __call__(self, image: ImageArray, depth: Float32Array | None) -> npt.NDArray[Any]: ...


def make_inputs(
    options: PoseOptions, encoder: str, settings: Settings, say: Callable[[str], None] | None = None
) -> Inputs:
    """Raises UsageError where frozen features are wanted of an encoder that is no ``onnx:`` file, ModelError."""
    if options.backbone != FROZEN:
        return PixelInputs(options.takes_depth)
    if not encoder.startswith("onnx:"):
        raise UsageError(
            f"--method {options.kind}: frozen features come from an encoder onnx:FILE, and the encoder is {encoder}; "
            "set SEMDB_ENCODER, or train a whole network with --pose-backbone resnet34"
        )
    inputs = FrozenInputs(resolve_onnx(encoder, settings), options.takes_depth, settings)
    if say is not None and not inputs.spatial:
        say(f"{encoder}: its embedding is no mean of a map, so {options.kind} learns from the embedding itself")
    return inputs


class PixelInputs:
    """The whole image as 224x224, uint8 ``[3, 224, 224]``; with depth a fourth plane, 0 to 255 for 0 to 8 m."""

    model: ModelInfo | None = None

    def __init__(self, with_depth: bool) -> None:
        self._with_depth = with_depth

    def __call__(self, image: ImageArray, depth: Float32Array | None) -> npt.NDArray[Any]:
        planes = whole_image(image).transpose(2, 0, 1)
        if not self._with_depth:
            return np.ascontiguousarray(planes)
        metres = depth_plane(depth, SIDE, SIDE)
        return np.concatenate([planes, np.rint(metres * (255 / 2)).astype(np.uint8)[None]])


class FrozenInputs:
    """The last map of an ONNX encoder, before it is pooled, float16 ``[C, h, w]``; 16 depths per cell behind it.

    The map is what an encoder's embedding is the mean of. It is found in the graph; where there is none (`spatial` is
    false) the embedding itself is a map of one cell.
    """

    def __init__(self, path: Path, with_depth: bool, settings: Settings) -> None:
        self._session, self._output, self.spatial = _open(path, settings)
        self._input = self._session.get_inputs()[0].name
        self._path, self._with_depth = path, with_depth
        self.model = ModelInfo("encoder", f"onnx:{path.name}", onnx_sha256(path), '{"input":"whole image"}')

    def __call__(self, image: ImageArray, depth: Float32Array | None) -> npt.NDArray[Any]:
        batch = whole_image(image).transpose(2, 0, 1)[None].astype(np.float32) / np.float32(255)
        try:
            (found,) = self._session.run([self._output], {self._input: batch})
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise ModelError(f"{self._path} failed on an image: {first_line(error)}") from error
        cells = np.asarray(found, dtype=np.float32)[0]
        cells = cells.reshape(-1, 1, 1) if cells.ndim == 1 else cells
        if self._with_depth:
            _, rows, columns = cells.shape
            plane = depth_plane(depth, rows * _CELL, columns * _CELL)
            own = plane.reshape(rows, _CELL, columns, _CELL).transpose(1, 3, 0, 2).reshape(_CELL**2, rows, columns)
            cells = np.concatenate([cells, own])
        small: npt.NDArray[Any] = cells.astype(np.float16)
        return small


def whole_image(image: ImageArray) -> ImageArray:
    """All of an RGB image at 224x224: a crop would hide what tells where the camera is."""
    resized: ImageArray = cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA)
    return resized


def depth_plane(depth: Float32Array | None, rows: int, columns: int) -> Float32Array:
    """Depth ``[H, W]`` as ``[rows, columns]`` in units of 4 m, at most 2; 0 where there is none."""
    if depth is None:
        return np.zeros((rows, columns), dtype=np.float32)
    small = cv2.resize(depth, (columns, rows), interpolation=cv2.INTER_NEAREST)  # a mean would spread the holes
    plane: Float32Array = np.clip(np.nan_to_num(small, nan=0.0) / DEPTH_UNIT_M, 0.0, 2.0).astype(np.float32)
    return plane


def _open(path: Path, settings: Settings) -> tuple[Any, str, bool]:
    """A session that gives the map under `embedding`, the name of that output, and whether it is a map."""
    import onnxruntime as ort

    try:
        import onnx
    except ImportError as error:
        raise ModelError(f"frozen features need onnx, to take a map out of {path}: {INSTALL}") from error
    onnx_sha256(path)  # raises what is wrong with the file
    try:
        model = onnx.load(str(path))
        name, spatial = _map_of(model.graph)
        if spatial:
            model.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
        options = ort.SessionOptions()
        options.intra_op_num_threads = settings.threads
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        providers = onnx_providers(settings.device, ort.get_available_providers())
        session = ort.InferenceSession(model.SerializeToString(), options, providers=providers)
    except (ModelError, UsageError):
        raise
    except Exception as error:  # ONNX's and ONNX Runtime's exceptions share no base class
        raise ModelError(f"{path} cannot be opened as an ONNX model ({first_line(error)})") from error
    if name not in [output.name for output in session.get_outputs()]:
        raise ModelError(f"{path} has no output embedding, so it is no encoder")
    return session, name, spatial


def _map_of(graph: Any) -> tuple[str, bool]:
    """The name of the map that `embedding` is pooled from; `embedding` itself where there is none."""
    makers = {output: node for node in graph.node for output in node.output}
    name, pooled = "embedding", False
    while name in makers and makers[name].op_type in (*_POOLS, *_SHAPES):
        if pooled and makers[name].op_type in _POOLS:
            break  # a pool within the network
        pooled = pooled or makers[name].op_type in _POOLS
        name = makers[name].input[0]
    return (name, True) if pooled and name in makers else ("embedding", False)
