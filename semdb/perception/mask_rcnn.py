"""Mask R-CNN in torchvision: its architectures, which one a checkpoint is of, and how it is run."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
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
        network = maskrcnn_resnet50_fpn_v2(weights=None, weights_backbone=None, num_classes=classes, **sizes)
        return _keep_boxes_exact(network)
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
    return _keep_boxes_exact(network)


def _keep_boxes_exact(network: Any) -> Any:
    """`network` with anchors, boxes and scores in float32 under autocast too.

    torchvision computes boxes in the precision of what its layers give: half precision has steps of a whole pixel from
    1024 on. Layers run in the precision of the context; what they hand on is float32 again.
    """
    heads = network.roi_heads
    for module in (network.backbone, network.rpn.head, heads.box_predictor, heads.mask_predictor):
        module.register_forward_hook(lambda _, __, result: _as_float32(result))
    return network


def _as_float32(result: Any) -> Any:
    if isinstance(result, Mapping):
        return {name: _as_float32(value) for name, value in result.items()}
    if isinstance(result, (tuple, list)):
        return type(result)(_as_float32(value) for value in result)
    return result.float()


def infer(network: Any, images: Sequence[Any], mask_above: float) -> list[dict[str, Any]]:
    """What `network` finds in each of `images`, tensors ``[3, H, W]`` of one size, float32 RGB 0..1, on its device.

    ``boxes``, ``labels`` and ``scores`` as torchvision gives them, by descending score; ``masks`` ``[M, 1, H, W]``
    of the first M alone, whose score is at least `mask_above`: the mask head is a quarter of the work on a CPU when it
    sees a hundred boxes, most of which are too weak to be objects.
    """
    import torch
    from torchvision.models.detection.roi_heads import maskrcnn_inference
    from torchvision.models.detection.transform import resize_boxes

    heads, size = network.roi_heads, tuple(images[0].shape[-2:])
    batch, _ = network.transform(list(images))
    features = network.backbone(batch.tensors)
    proposals, _ = network.rpn(batch, features)
    regions = heads.box_head(heads.box_roi_pool(features, proposals, batch.image_sizes))
    found = heads.postprocess_detections(*heads.box_predictor(regions), proposals, batch.image_sizes)
    results = [
        {"boxes": resize_boxes(boxes, inside, size), "labels": labels, "scores": scores}
        for boxes, scores, labels, inside in zip(*found, batch.image_sizes, strict=True)
    ]
    counts = [int((scores >= mask_above).sum()) for scores in found[1]]  # scores descend
    strong = [{"boxes": b[:n], "labels": k[:n]} for b, k, n in zip(found[0], found[2], counts, strict=True)]
    if sum(counts):
        pooled = heads.mask_roi_pool(features, [one["boxes"] for one in strong], batch.image_sizes)
        logits = heads.mask_predictor(heads.mask_head(pooled))
        for one, masks in zip(strong, maskrcnn_inference(logits, [one["labels"] for one in strong]), strict=True):
            one["masks"] = masks
        network.transform.postprocess(strong, batch.image_sizes, [size] * len(strong))
    for result, one in zip(results, strong, strict=True):
        result["masks"] = one.get("masks", torch.zeros((0, 1, *size), device=result["boxes"].device))
    return results


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
