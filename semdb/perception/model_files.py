"""Files of networks: where a spec's file is, its hash, and how ONNX Runtime opens it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semdb.errors import ModelError, UsageError
from semdb.perception.onnx_external import external_files
from semdb.settings import Settings

GPU_BATCH = 8  # images at once that keep a GPU busy
_HASHES: dict[tuple[str, int, int], str] = {}


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file's bytes, computed once per process for a path, size and modification time.

    Raises ModelError naming the file when it cannot be read.
    """
    try:
        stat = path.stat()
        key = (str(path.resolve()), stat.st_size, stat.st_mtime_ns)
        if key not in _HASHES:
            with path.open("rb") as file:
                _HASHES[key] = hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ModelError(f"{path}: cannot read the model file ({error.strerror}); check its permissions") from error
    return _HASHES[key]


def onnx_sha256(path: Path) -> str:
    """Hex SHA-256 of an ONNX model: of the file, or, where it takes weights from others, of all their hashes together.

    Raises ModelError.
    """
    others = external_files(path)
    if not others:
        return file_sha256(path)
    missing = [str(other) for other in others if not other.is_file()]
    if missing:
        raise ModelError(f"{path} takes weights from {', '.join(missing)}, which is not there: keep both in one folder")
    digest = hashlib.sha256(file_sha256(path).encode())
    for other in others:
        digest.update(f"|{other.relative_to(path.parent)}|{file_sha256(other)}".encode())
    return digest.hexdigest()


def models_dir(settings: Settings) -> Path:
    """The folder where a bare file name of a spec is looked for when it is not in the current folder."""
    return settings.cache_dir.expanduser() / "models"


def resolve_onnx(spec: str, settings: Settings) -> Path:
    """The file of a spec ``onnx:FILE``: ``~`` is expanded, a bare name is also looked for in the models folder.

    Raises ModelError when the file is not there or is a folder.
    """
    return resolve_file(spec, "onnx:", "an .onnx file", settings)


def resolve_file(spec: str, prefix: str, kind: str, settings: Settings) -> Path:
    """The file of a spec `prefix` + FILE, as for `resolve_onnx`; `kind` says in errors what the file should be."""
    text = spec.removeprefix(prefix)
    if not text:
        raise ModelError(f"{spec!r} names no file: write {prefix}FILE, with FILE the path of {kind}")
    path = Path(text).expanduser()
    tried = [path]
    if path.name == text:
        tried.append(models_dir(settings) / text)
    for candidate in tried:
        if candidate.is_file():
            return candidate
    if path.is_dir():
        raise ModelError(f"{path} is a folder: write {prefix}FILE, with FILE the path of {kind} in it")
    places = " or ".join(str(candidate) for candidate in tried)
    raise ModelError(f"no model file at {places} (from the spec {spec!r}): check the path, or put the file there")


def canonical_json(config: dict[str, Any]) -> str:
    """`config` as JSON with sorted keys and no spaces, so that equal configurations are equal strings."""
    return json.dumps(config, sort_keys=True, separators=(",", ":"))


class OnnxModel:
    """An ONNX network with one image input ``[B, 3, H, W]``.

    `path` is the file, `outputs` the names of all its outputs, `metadata` its ``metadata_props``, `sha256` the hash of
    all its weights, those in other files too.
    """

    def __init__(self, path: Path, threads: int, required_outputs: tuple[str, ...], device: str = "cpu") -> None:
        """Open `path` on `device` (on the CPU with `threads` threads); its outputs must include `required_outputs`.

        Raises ModelError when the file is no ONNX model or has other inputs or outputs, UsageError when this ONNX
        Runtime cannot use the device.
        """
        import onnxruntime as ort

        self.sha256 = onnx_sha256(path)  # before it is opened: no file out of its folder is
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        # Idle ORT threads otherwise burn the cores that the local features need.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        self.path = path
        providers = onnx_providers(device, ort.get_available_providers())
        try:
            self._session = ort.InferenceSession(str(path), options, providers=providers)
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise ModelError(
                f"{path} cannot be opened as an ONNX model ({first_line(error)}); is it complete, and a model?"
            ) from error
        self.outputs = tuple(output.name for output in self._session.get_outputs())
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)
        missing = [name for name in required_outputs if name not in self.outputs]
        if missing:
            raise ModelError(
                f"{path} has no output {', '.join(missing)} (it has {', '.join(self.outputs)}): "
                f"it is not a model for this role, or its outputs must be renamed to {', '.join(required_outputs)}"
            )
        self._required = required_outputs
        inputs = self._session.get_inputs()
        if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(inputs[0].shape) != 4:
            found = "; ".join(f"{i.name}: {i.type} {i.shape}" for i in inputs)
            raise ModelError(f"{path} must have one input, float32 [B, 3, H, W] RGB 0..1, but has {found}")
        self._input = inputs[0].name
        self.takes_batches = inputs[0].shape[0] != 1  # a name or None where it is free
        self.on_gpu = "CUDAExecutionProvider" in self._session.get_providers()

    def last_size(self, output: str) -> int | None:
        """The length of the last axis of an output, where the file says it."""
        shape = next(found.shape for found in self._session.get_outputs() if found.name == output)
        return int(shape[-1]) if shape and isinstance(shape[-1], int) else None

    def run(self, batch: Any) -> list[Any]:
        """The required outputs, in their order, for a float32 `batch` ``[B, 3, H, W]``. Raises ModelError."""
        try:
            return list(self._session.run(list(self._required), {self._input: batch}))
        except Exception as error:
            shape = "x".join(str(n) for n in batch.shape)
            raise ModelError(f"{self.path} failed on an input of {shape}: {first_line(error)}") from error


def onnx_providers(device: str, available: Sequence[str]) -> list[Any]:
    """ONNX Runtime's providers for a device setting, given those that it has; ``auto`` is CUDA where there is one.

    Raises UsageError for a device that it does not have.
    """
    cpu, cuda = "CPUExecutionProvider", "CUDAExecutionProvider"
    if device == "cpu" or (device == "auto" and cuda not in available):
        return [cpu]
    if device == "mps" or cuda not in available:
        raise UsageError(
            f"SEMDB_DEVICE={device}: the installed ONNX Runtime runs on {', '.join(available)}; use cpu or auto"
            + ("" if device == "mps" else ", or install onnxruntime-gpu in place of onnxruntime")
        )
    return [(cuda, {"device_id": int(device.partition(":")[2] or 0)}), cpu]


def first_line(error: Exception) -> str:
    """The first line of an error's text, for a message on one line."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]
