"""Mask R-CNN in torchvision: its architectures, and which one a checkpoint is of."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from semdb.errors import ModelError
from semdb.perception.torch_models import import_torch, load_weights

_DEPTHS = {
    ("basic", 2): "resnet18",
    ("basic", 6): "resnet34",
    ("bottleneck", 6): "resnet50",
    ("bottleneck", 23): "resnet101",
    ("bottleneck", 36): "resnet152",
}
BACKBONES = tuple(_DEPTHS.values())


@dataclass(frozen=True, slots=True)
class Architecture:
    """`backbone` is one of `BACKBONES`, `version` 1 (frozen statistics, torchvision's first) or 2 (v2's heads).

    `epsilon` is that of frozen batch normalisation. `min_size`, `max_size`: the image is resized inside so that its
    shorter side has `min_size` pixels, the longer one at most `max_size`. `anchor`: side of the smallest anchor boxes
    in pixels of the resized image; each of the five levels doubles it. `channels` are those of FPN and heads: 256 in
    the paper; 64 cost a tenth, for small data and CPUs.
    """

    backbone: str = "resnet50"
    version: int = 1
    epsilon: float = 1e-5
    min_size: int = 800
    max_size: int = 1333
    anchor: int = 32
    channels: int = 256

    @property
    def name(self) -> str:
        return f"maskrcnn_{self.backbone}_fpn" + ("_v2" if self.version == 2 else "")


def build(architecture: Architecture, classes: int, *, frozen: bool = True) -> Any:
    """The network, randomly initialised, for `classes` names with the background at 0.

    `frozen` False gives version 1 statistics that are learnt: from random weights it does not train without. Both
    have the same weights and, in inference, the same results. Raises ModelError.
    """
    import_torch()
    import torchvision
    from torch.nn import BatchNorm2d
    from torchvision.models.detection import MaskRCNN, maskrcnn_resnet50_fpn_v2
    from torchvision.models.detection.anchor_utils import AnchorGenerator
    from torchvision.models.detection.backbone_utils import BackboneWithFPN
    from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
    from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
    from torchvision.ops import FrozenBatchNorm2d
    from torchvision.ops.feature_pyramid_network import LastLevelMaxPool

    sizes = {"min_size": architecture.min_size, "max_size": architecture.max_size}
    if architecture.version == 2:
        if architecture.backbone != "resnet50":
            raise ModelError(f"{architecture.name}: version 2 of Mask R-CNN is known with resnet50 only")
        return maskrcnn_resnet50_fpn_v2(weights=None, weights_backbone=None, num_classes=classes, **sizes)
    norm = FrozenBatchNorm2d if frozen else BatchNorm2d
    width = architecture.channels
    body = getattr(torchvision.models, architecture.backbone)(weights=None, norm_layer=norm)
    inner = [body.inplanes // 8 << k for k in range(4)]
    layers = {f"layer{k + 1}": str(k) for k in range(4)}
    backbone = BackboneWithFPN(body, layers, inner, width, LastLevelMaxPool())
    network = MaskRCNN(
        backbone,
        **sizes,
        rpn_anchor_generator=AnchorGenerator(
            tuple((architecture.anchor << k,) for k in range(5)), ((0.5, 1.0, 2.0),) * 5
        ),
        box_head=TwoMLPHead(width * 7**2, 4 * width),
        box_predictor=FastRCNNPredictor(4 * width, classes),
        mask_head=MaskRCNNHeads(width, (width,) * 4, 1),
        mask_predictor=MaskRCNNPredictor(width, width, classes),
    )
    for module in network.modules():
        if isinstance(module, FrozenBatchNorm2d):
            module.eps = architecture.epsilon
    return network


def recognise(tensors: Mapping[str, Any], path: Path) -> tuple[Architecture, int]:
    """The architecture of a checkpoint and the number of its classes, from names and shapes.

    Raises ModelError when it is no Mask R-CNN with a ResNet-FPN.
    """
    scores = tensors.get("roi_heads.box_predictor.cls_score.weight")
    blocks = {int(m[1]) for name in tensors if (m := re.match(r"backbone\.body\.layer3\.(\d+)\.", name))}
    kind = "bottleneck" if "backbone.body.layer3.0.conv3.weight" in tensors else "basic"
    backbone = _DEPTHS.get((kind, len(blocks)))
    if scores is None or backbone is None or "roi_heads.mask_predictor.mask_fcn_logits.weight" not in tensors:
        raise ModelError(
            f"{path} is no checkpoint of torchvision's Mask R-CNN with a ResNet-FPN: it lacks "
            + ("roi_heads.box_predictor.cls_score.weight" if scores is None else "a known backbone or the mask head")
        )
    version = 2 if "roi_heads.box_head.0.0.weight" in tensors else 1
    fpn = tensors.get("backbone.fpn.layer_blocks.0.0.weight")
    channels = 256 if fpn is None or version == 2 else int(fpn.shape[0])
    return Architecture(backbone, version, channels=channels), int(scores.shape[0])


def modern_names(tensors: Mapping[str, Any]) -> dict[str, Any]:
    """`tensors` under the names of today: files written before torchvision 0.14 name FPN, RPN and mask head else."""
    rules = (
        (r"^(backbone\.fpn\.(?:inner|layer)_blocks\.\d+)\.(weight|bias)$", r"\1.0.\2"),
        (r"^rpn\.head\.conv\.(weight|bias)$", r"rpn.head.conv.0.0.\1"),
    )
    renamed = {}
    for name, value in tensors.items():
        new = name
        for pattern, replacement in rules:
            new = re.sub(pattern, replacement, new)
        if match := re.match(r"^roi_heads\.mask_head\.mask_fcn(\d+)\.(weight|bias)$", new):
            new = f"roi_heads.mask_head.{int(match[1]) - 1}.0.{match[2]}"
        renamed[new] = value
    return renamed


def load(tensors: Mapping[str, Any], path: Path, architecture: Architecture | None = None) -> tuple[Any, Architecture]:
    """The network of a checkpoint with its weights, in training mode, and what it is.

    With `architecture` the checkpoint must be of that one. Raises ModelError when names or shapes do not fit.
    """
    tensors = modern_names(tensors)
    found, classes = recognise(tensors, path)
    if architecture is not None:
        if (found.backbone, found.version) != (architecture.backbone, architecture.version):
            raise ModelError(f"{path} is a checkpoint of {found.name}, not of {architecture.name}")
        found = architecture
    network = build(found, classes)
    load_weights(network, tensors, path, found.name)
    return network, found
