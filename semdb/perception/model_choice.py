"""Which detector, encoder and feature to use where the settings say ``auto``, and what to tell people about it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from semdb.errors import ModelError, UsageError
from semdb.perception.catalogue import BY_NAME
from semdb.perception.encoders.crops import CROPS, DEFAULT, crop_of
from semdb.perception.model_files import models_dir, resolve_file, resolve_onnx
from semdb.perception.torch_models import resolve_checkpoint
from semdb.settings import Settings
from semdb.types import ModelInfo

AUTO = "auto"
ROLES = ("detector", "encoder", "features")


@dataclass(frozen=True, slots=True)
class ModelSpecs:
    """Concrete specs, and a line for people about each that nobody asked for by name."""

    detector: str
    encoder: str
    features: str
    notes: tuple[str, ...] = ()


def specs_for_ingest(settings: Settings, map_models: Sequence[ModelInfo], *, has_masks: bool) -> ModelSpecs:
    """What describes a recording: the settings, else what the map was described by, else what needs no file.

    `has_masks` tells whether the recording brings object masks. Raises UsageError when no detector is at hand, or
    masks are to be the detections and there are none.
    """
    known = {model.role: model for model in map_models}
    chosen: dict[str, str] = {}
    notes: list[str] = []
    fallback = {"detector": "recorded" if has_masks else "", "encoder": "gist", "features": "surf"}
    reason = {
        "detector": "SEMDB_DETECTOR is not set: the masks that come with the recording are the detections",
        "encoder": "SEMDB_ENCODER is not set: places are described by gist, which needs no model file",
        "features": "",
    }
    for role in ROLES:
        spec = str(getattr(settings, role))
        if spec == AUTO and role in known:
            spec = _spec_of(known[role], settings)
        elif spec == AUTO:
            spec = fallback[role]
            notes += [reason[role]] if reason[role] and spec else []
        chosen[role] = spec
    if not chosen["detector"]:
        raise UsageError(
            "this recording brings no object masks, so a detector is needed: set SEMDB_DETECTOR=onnx:FILE "
            "or torchvision:NAME (a Mask R-CNN, see docs/models.md) or pass --detector"
        )
    if chosen["detector"].removeprefix("whole-").removeprefix("boxes:") == "recorded" and not has_masks:
        raise UsageError(
            f"the detector is {chosen['detector']!r}, but this recording brings no object masks: set "
            "SEMDB_DETECTOR=onnx:FILE or pass --detector, and --map where the map holds recordings with masks"
        )
    return ModelSpecs(chosen["detector"], chosen["encoder"], chosen["features"], tuple(notes))


def specs_for_query(settings: Settings, map_models: Sequence[ModelInfo]) -> ModelSpecs:
    """What describes a query: the settings, else what the map was described by.

    Raises UsageError when the file of a map's model is not at hand.
    """
    known = {model.role: model for model in map_models}
    chosen = {}
    for role in ROLES:
        spec = str(getattr(settings, role))
        chosen[role] = _spec_of(known[role], settings) if spec == AUTO and role in known else spec
    if AUTO in chosen.values():
        missing = ", ".join(role for role in ROLES if chosen[role] == AUTO)
        raise UsageError(
            f"the map does not say which {missing} made it: ingest a recording first where it holds no keyframe yet, "
            f"or set SEMDB_{missing.split(', ')[0].upper()}"
        )
    return ModelSpecs(chosen["detector"], chosen["encoder"], chosen["features"])


def settings_of_map(settings: Settings, map_models: Sequence[ModelInfo]) -> Settings:
    """`settings` with what is not set there taken from the configuration that the map's rows were made with.

    So a query, or a second recording, is described as the map was. What is set and differs stays: comparing the
    models then says so.
    """
    taken: dict[str, Any] = {}
    for model in map_models:
        config = _config(model)
        for name in ("score_threshold", "max_keypoints"):
            if name in config and name not in settings.model_fields_set:
                taken[name] = config[name]
        if model.role == "encoder" and settings.encoder_crop == AUTO:
            taken["encoder_crop"] = crop_of(config) or AUTO
        if model.role == "detector":
            for name in ("classes", "dynamic"):
                if name in config and name not in settings.model_fields_set:
                    taken[name] = ",".join(config[name])
    return settings.model_copy(update=taken)


def spec_for_redescription(settings: Settings, stored: ModelInfo) -> tuple[str, Settings]:
    """The encoder that describes a map anew, whose vectors are by `stored`, and the settings that it is loaded with.

    It is the one that settings name, else the map's own, shown what a new map's is. Raises UsageError where its file
    is not at hand.
    """
    spec = _spec_of(stored, settings) if settings.encoder == AUTO else settings.encoder
    return spec, settings


def crop_of_model(encoder: ModelInfo) -> str | None:
    """The crop that vectors were made with; None for an encoder that has none. Raises ModelError."""
    return crop_of(_config(encoder))


def older_crop(models: Sequence[ModelInfo]) -> tuple[str, str] | None:
    """The crop that a map's vectors were made with and the one of new maps, where they differ. Raises ModelError."""
    crops = [crop_of_model(model) for model in models if model.role == "encoder"]
    return (crops[0], DEFAULT) if crops and crops[0] not in (None, DEFAULT) else None


def dynamic_classes(map_models: Sequence[ModelInfo]) -> frozenset[str]:
    """Classes of objects that move, as the map's detector was told. Raises ModelError for what no semdb wrote."""
    return frozenset(name for m in map_models if m.role == "detector" for name in _config(m).get("dynamic", ()))


def _config(model: ModelInfo) -> dict[str, Any]:
    """What of a configuration settings take. Raises ModelError for what no semdb wrote."""
    try:
        config = json.loads(model.config)
    except (ValueError, RecursionError):
        config = None
    if not isinstance(config, dict):
        shown = repr(model.config[:60])
        raise ModelError(f"the configuration (models.config) of the {model.role} {model.name} is no object: {shown}")
    for name, is_right in _RIGHT.items():
        if name in config and not is_right(config[name]):
            raise ModelError(
                f"the configuration (models.config) of the {model.role} {model.name} has an impossible {name}: "
                f"{json.dumps(config[name])[:60]}"
            )
    return config


def _is_number(value: object, least: float, most: float) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most


def _are_names(value: object) -> bool:
    return isinstance(value, list) and all(isinstance(name, str) for name in value)


_RIGHT: dict[str, Callable[[object], bool]] = {
    "score_threshold": lambda value: _is_number(value, 0, 1),
    "max_keypoints": lambda value: isinstance(value, int) and _is_number(value, 1, 20_000),
    "classes": _are_names,
    "dynamic": _are_names,
    "view": lambda value: value in CROPS,
}


def _spec_of(model: ModelInfo, settings: Settings, before: str = "") -> str:
    """The spec that loads `model` here; files are looked for where bare names are."""
    kind, _, name = model.name.partition(":")
    if kind in ("boxes", "whole-boxes"):
        return f"{kind}:{_spec_of(replace(model, name=name), settings, f'{kind}:')}"
    if kind not in ("onnx", "torchvision", "fasterrcnn", "ssd"):
        return model.name
    try:
        if kind in ("fasterrcnn", "ssd"):
            path = resolve_file(model.name, f"{kind}:", "a checkpoint (.pth)", settings)
        else:
            path = (resolve_onnx if kind == "onnx" else resolve_checkpoint)(model.name, settings)
    except ModelError as error:
        fetch = f", fetch it with `semdb models pull {name}`" if kind == "torchvision" and name in BY_NAME else ""
        raise UsageError(
            f"the map was described by the {model.role} {model.name} (sha256 {model.sha256[:12]}), which is not at "
            f"hand: set SEMDB_{model.role.upper()}={before}{kind}:PATH to that file{fetch}, or put it into "
            f"{models_dir(settings)}"
        ) from error
    return model.name if name in BY_NAME else f"{kind}:{path}"
