"""torch, where it is installed: which device, how a checkpoint is read and checked. Never imports torch by itself."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError, UsageError
from semdb.perception.catalogue import BY_NAME
from semdb.perception.model_files import GPU_BATCH, first_line, models_dir, resolve_file
from semdb.settings import Settings

INSTALL = "pip install 'semdb[torch]'"
_PICKLE, _ZIP = b"\x80", b"PK\x03\x04"  # how files of torch.save begin: the format of before torch 1.6, and today's


def import_torch() -> Any:
    """The module torch. Raises ModelError that says how to install it, together with a torchvision that fits it."""
    try:
        import torch
        import torchvision  # a torchvision that does not fit its torch fails here
    except ImportError as error:
        raise ModelError(
            f"torchvision: models need torch and torchvision ({first_line(error)}): {INSTALL}, or export the model "
            "elsewhere (semdb models export) and use onnx:FILE"
        ) from error
    except RuntimeError as error:  # "operator torchvision::nms does not exist"
        raise ModelError(
            f"this torchvision does not fit this torch ({first_line(error)}): install both from one place, {INSTALL}"
        ) from error
    assert torchvision is not None
    return torch


def choose_device(name: str, torch: Any) -> Any:
    """The ``torch.device`` of a setting: ``auto`` (cuda, then mps, then cpu), ``cpu``, ``cuda``, ``cuda:1``, ``mps``.

    Raises UsageError when that device is not there: nothing falls back in silence.
    """
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    if name == "cpu":
        return torch.device("cpu")
    if name == "mps":
        if not torch.backends.mps.is_available():
            raise UsageError("SEMDB_DEVICE=mps: torch finds no Metal device here; use cpu, or auto")
        return torch.device("mps")
    if not torch.cuda.is_available():
        raise UsageError(f"SEMDB_DEVICE={name}: torch finds no CUDA device here; use cpu, or auto")
    count = int(torch.cuda.device_count())
    number = int(name.partition(":")[2] or 0)
    if number >= count:
        raise UsageError(f"SEMDB_DEVICE={name}: there are {count} CUDA devices, cuda:0 to cuda:{count - 1}")
    return torch.device(name)


def best_batch(device: Any) -> int:
    """How many images at once keep `device` busy: several on a GPU; on a CPU one is as fast as many, and takes less."""
    return GPU_BATCH if device.type in ("cuda", "mps") else 1


def layer_precision(device: Any, torch: Any) -> AbstractContextManager[Any]:
    """The precision of convolutions and products: half on CUDA, float32 elsewhere. Boxes and losses are float32."""
    if device.type == "cuda":
        context: AbstractContextManager[Any] = torch.autocast("cuda", dtype=torch.float16)
        return context
    return nullcontext()


def prepare(module: Any, settings: Settings, torch: Any) -> Any:
    """`module` for inference on the device of `settings`; sets the number of CPU threads of the process."""
    torch.set_num_threads(settings.threads)
    return module.eval().requires_grad_(False).to(choose_device(settings.device, torch))


def to_device(array: npt.NDArray[np.generic], device: Any, torch: Any) -> Any:
    """`array` as a tensor on `device`; to CUDA from pinned memory, so that the transfer runs beside other work."""
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a file written by ``torch.save`` holds: a dict. Only tensors and plain values are unpickled.

    Raises ModelError naming the file when it is none, is damaged, or would run code.
    """
    torch = import_torch()
    try:
        with path.open("rb") as file:
            begins = file.read(4)
        if begins[:1] != _PICKLE and begins != _ZIP:
            raise ModelError(f"{path} cannot be read as a torch checkpoint: it begins with {begins!r}; is it one?")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of its own old file format
            content = torch.load(path, map_location="cpu", weights_only=True)
    except ModelError:
        raise
    except Exception as error:  # zip, pickle, struct and runtime errors: torch has no base class for them
        if "weights_only" in str(error).lower() or "Unsupported" in str(error):
            raise ModelError(
                f"{path} holds more than weights and is not loaded, because reading it could run code: save the "
                "model's state_dict() instead"
            ) from error
        raise ModelError(
            f"{path} cannot be read as a torch checkpoint ({first_line(error)}); is it complete, and a checkpoint?"
        ) from error
    if not isinstance(content, Mapping):
        raise ModelError(f"{path} holds a {type(content).__name__}, not weights: save the model's state_dict()")
    return dict(content)


def state_dict_of(content: Mapping[str, Any], path: Path) -> dict[str, Any]:
    """The tensors by name: of `content` itself, or of its ``state_dict`` or ``model``; ``module.`` prefixes go.

    Raises ModelError when there are none.
    """
    for key in ("state_dict", "model"):
        if isinstance(content.get(key), Mapping):
            content = content[key]
            break
    tensors = {str(name): value for name, value in content.items() if hasattr(value, "shape")}
    if not tensors:
        raise ModelError(f"{path} holds no weights (its keys are {_some(list(content))})")
    if all(name.startswith("module.") for name in tensors):  # saved from DataParallel
        tensors = {name.removeprefix("module."): value for name, value in tensors.items()}
    return tensors


def load_weights(module: Any, tensors: Mapping[str, Any], path: Path, what: str) -> None:
    """Copies `tensors` into `module`, every one of the right name and shape.

    Counters of batches, which no result depends on, may be missing or left over. Raises ModelError naming what does
    not fit; `what` is what the file was taken for.
    """
    wanted = module.state_dict()
    counters = re.compile(r"(^|\.)num_batches_tracked$")
    missing = [name for name in wanted if name not in tensors and not counters.search(name)]
    extra = [name for name in tensors if name not in wanted and not counters.search(name)]
    if missing or extra:
        parts = [f"{len(missing)} missing ({_some(missing)})"] if missing else []
        parts += [f"{len(extra)} that it does not know ({_some(extra)})"] if extra else []
        raise ModelError(f"{path} is no checkpoint of {what}: of its weights " + " and ".join(parts))
    for name, value in wanted.items():
        if name in tensors and tuple(tensors[name].shape) != tuple(value.shape):
            shapes = f"{list(tensors[name].shape)}, wanted is {list(value.shape)}"
            raise ModelError(f"{path} is no checkpoint of {what}: {name} is {shapes}")
    module.load_state_dict({name: tensors.get(name, value) for name, value in wanted.items()}, strict=True)


def _some(names: list[Any], count: int = 3) -> str:
    return ", ".join(map(str, names[:count])) + (", …" if len(names) > count else "")


def resolve_checkpoint(spec: str, settings: Settings) -> Path:
    """The file of a spec ``torchvision:NAME`` (a published one, in the models folder) or ``torchvision:PATH``.

    Raises UsageError for a spec that is neither, ModelError saying which command fetches it, or that there is no such
    file.
    """
    text = spec.removeprefix("torchvision:")
    if text == spec:
        raise UsageError(f"{spec}: write torchvision:PATH, or torchvision:NAME with one of {', '.join(BY_NAME)}")
    known = BY_NAME.get(text)
    if known is None:
        try:
            return resolve_file(spec, "torchvision:", "a checkpoint (.pth)", settings)
        except ModelError as error:
            names = "" if "." in text or "/" in text else f"; published models are {', '.join(BY_NAME)}"
            raise ModelError(f"{error}{names}") from error
    path = models_dir(settings) / known.file
    if not path.is_file():
        raise ModelError(
            f"{spec}: {path} is not there: fetch it with `semdb models pull {known.name}` ({known.megabytes} MB from "
            f"{known.url}), or bring that file from another machine and put it there"
        )
    return path
