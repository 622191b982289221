"""torch networks as ONNX files that semdb's `onnx:` detector and encoder read, and how alike both are."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semdb.errors import ModelError, UsageError
from semdb.perception.catalogue import BY_NAME
from semdb.perception.detectors.torchvision import known_architecture, load_detector_checkpoint
from semdb.perception.encoders.crops import SIDE as CROP
from semdb.perception.encoders.torchvision import expected_outputs, load_encoder_checkpoint
from semdb.perception.model_files import file_sha256, first_line, onnx_sha256
from semdb.perception.torch_models import import_torch, resolve_checkpoint
from semdb.settings import Settings

OPSET = 17
_DETECTOR_OUTPUTS = ("boxes", "labels", "scores", "masks")
_METADATA_FIELD = 14  # metadata_props of ModelProto, a message of key (1) and value (2)


@dataclass(frozen=True, slots=True)
class Exported:
    """`role` is ``detector`` or ``encoder``; `sha256` is that of the new file."""

    path: Path
    role: str
    sha256: str


def export(spec: str, target: Path, settings: Settings) -> Exported:
    """Writes the network of ``torchvision:NAME`` or ``torchvision:PATH`` to `target` as one ONNX file.

    Detectors take ``[1, 3, H, W]`` of any size and carry their class names; encoders take ``[B, 3, 224, 224]``.
    Raises ModelError when the checkpoint is neither, or torch cannot export it, UsageError when there is no folder for
    `target`.
    """
    if not target.parent.is_dir():
        raise UsageError(f"{target}: {target.parent} is no folder")
    torch = import_torch()
    torch.set_num_threads(settings.threads)
    path = resolve_checkpoint(spec, settings)
    role = BY_NAME[name].role if (name := spec.removeprefix("torchvision:")) in BY_NAME else _role_of(path)
    metadata = {"source": f"{path.name}, SHA-256 {file_sha256(path)}", "name": path.name.partition(".")[0]}
    if name in BY_NAME:
        metadata |= {"licence": BY_NAME[name].licence, "name": name}
    new = target.with_name(target.name + ".new")
    try:
        if role == "detector":
            network, _, classes = load_detector_checkpoint(path, known_architecture(spec))
            metadata["classes"] = json.dumps(list(classes))
            _export_detector(network.eval(), new, torch)
        else:
            _export_encoder(load_encoder_checkpoint(path, expected_outputs(spec)), new, torch)
        _append_metadata(new, metadata)
        new.replace(target)
    finally:
        new.unlink(missing_ok=True)
    return Exported(target, role, onnx_sha256(target))


def _role_of(path: Path) -> str:
    try:
        load_detector_checkpoint(path)
    except ModelError as error:
        if "is no checkpoint of torchvision's Mask R-CNN" not in str(error):
            raise
        return "encoder"
    return "detector"


def _export_detector(network: Any, path: Path, torch: Any) -> None:
    class Contract(torch.nn.Module):  # type: ignore[misc]
        """One image with a batch dimension in, four arrays out; boxes end at the last pixel inside."""

        def __init__(self) -> None:
            super().__init__()
            self.network = network

        def forward(self, image: Any) -> tuple[Any, Any, Any, Any]:
            found = self.network([image[0]])[0]
            size = torch._shape_as_tensor(image)[2:].to(found["boxes"].dtype)
            last = torch.stack([size[1], size[0], size[1], size[0]]) - 1
            boxes = torch.minimum(found["boxes"].clamp(min=0), last)
            return boxes, found["labels"], found["scores"], found["masks"]

    generator = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 96, 128, generator=generator)
    axes: dict[str, dict[int, str]] = {"image": {2: "height", 3: "width"}}
    axes |= {name: {0: "objects"} for name in _DETECTOR_OUTPUTS}
    axes["masks"] |= {2: "height", 3: "width"}
    _write(Contract().eval(), image, path, _DETECTOR_OUTPUTS, axes, torch)


def _export_encoder(network: Any, path: Path, torch: Any) -> None:
    image = torch.rand(2, 3, CROP, CROP)
    _write(network, image, path, ("embedding",), {"image": {0: "batch"}, "embedding": {0: "batch"}}, torch)


def _write(
    network: Any, image: Any, path: Path, outputs: Sequence[str], axes: dict[str, dict[int, str]], torch: Any
) -> None:
    try:
        with _quiet(), torch.inference_mode():
            # torch.export, which the other exporter needs, does not trace torchvision's detection models
            torch.onnx.export(
                network,
                (image,),
                str(path),
                opset_version=OPSET,
                input_names=["image"],
                output_names=list(outputs),
                dynamic_axes=axes,
                dynamo=False,
            )
    except OSError:
        raise
    except Exception as error:  # the exporter raises all kinds
        raise ModelError(f"{path.name}: torch {torch.__version__} cannot export it: {first_line(error)}") from error


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Tracing warns of every branch that depends on the image; all of these are meant."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)


def _append_metadata(path: Path, metadata: dict[str, str]) -> None:
    """Adds `metadata` to an ONNX file: protobuf's repeated fields may follow the rest of a message."""
    with path.open("ab") as file:
        for key, value in metadata.items():
            entry = _field(1, key.encode()) + _field(2, value.encode())
            file.write(_field(_METADATA_FIELD, entry))


def _field(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])
