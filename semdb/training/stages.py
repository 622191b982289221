"""The three stages of fine-tuning (section III-B of the paper): heads, then the FPN too, then all layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

PARTS = ("heads", "fpn", "body")
_PREFIX = {"fpn": "backbone.fpn.", "body": "backbone.body."}


@dataclass(frozen=True, slots=True)
class Stage:
    """`parts` learn for `epochs` with the learning rate `rate`; all else stays as it is."""

    name: str
    parts: tuple[str, ...]
    epochs: int
    rate: float


def make_stages(epochs: tuple[int, int, int], rates: tuple[float, float, float]) -> tuple[Stage, ...]:
    """The paper's stages, those without epochs left out."""
    names = ("heads", "fpn and heads", "all layers")
    parts = (("heads",), ("heads", "fpn"), PARTS)
    stages = (Stage(n, p, e, r) for n, p, e, r in zip(names, parts, epochs, rates, strict=True))
    return tuple(stage for stage in stages if stage.epochs > 0)


def part_of(parameter: str) -> str:
    """``heads``, ``fpn`` or ``body`` of a parameter's name in torchvision's Mask R-CNN."""
    for part, prefix in _PREFIX.items():
        if parameter.startswith(prefix):
            return part
    return "heads"


def enter(network: Any, stage: Stage) -> None:
    """Puts `network` into training mode where `stage` learns; elsewhere weights and running statistics stay."""
    network.train()
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(part_of(name) in stage.parts)
    for name, module in network.named_modules():
        if hasattr(module, "running_mean") and part_of(f"{name}.") not in stage.parts:
            module.eval()
