"""The networks that others publish: where they are, what their files are called, and how those are recognised."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Published:
    """A file of weights. `spec` names it in settings; `sha256` is the start of its hash, "" where none is published.

    `megabytes` is for people.
    """

    name: str
    role: str
    spec: str
    file: str
    url: str
    sha256: str
    megabytes: int
    licence: str
    description: str


_TORCHVISION = "https://download.pytorch.org/models/"

PUBLISHED = (
    Published(
        name="maskrcnn_resnet50_fpn_v2",
        role="detector",
        spec="torchvision:maskrcnn_resnet50_fpn_v2",
        file="maskrcnn_resnet50_fpn_v2_coco-73cbd019.pth",
        url=_TORCHVISION + "maskrcnn_resnet50_fpn_v2_coco-73cbd019.pth",
        sha256="73cbd019",
        megabytes=177,
        licence="BSD-3-Clause (torchvision); trained on COCO",
        description="Mask R-CNN, ResNet-50-FPN, improved recipe; COCO box AP 47.4, mask AP 41.8 as published",
    ),
    Published(
        name="maskrcnn_resnet50_fpn",
        role="detector",
        spec="torchvision:maskrcnn_resnet50_fpn",
        file="maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
        url=_TORCHVISION + "maskrcnn_resnet50_fpn_coco-bf2d0c1e.pth",
        sha256="bf2d0c1e",
        megabytes=170,
        licence="BSD-3-Clause (torchvision); trained on COCO",
        description="Mask R-CNN, ResNet-50-FPN; COCO box AP 37.9, mask AP 34.6 as published",
    ),
    Published(
        name="resnet50-places365",
        role="encoder",
        spec="torchvision:resnet50-places365",
        file="resnet50_places365.pth.tar",
        url="http://places2.csail.mit.edu/models_places365/resnet50_places365.pth.tar",
        sha256="",
        megabytes=97,
        licence="CC BY (MIT CSAIL, Places365-CNNs)",
        description="ResNet-50 trained on Places365, 2048-d; what the paper uses",
    ),
    Published(
        name="resnet50",
        role="encoder",
        spec="torchvision:resnet50",
        file="resnet50-0676ba61.pth",
        url=_TORCHVISION + "resnet50-0676ba61.pth",
        sha256="0676ba61",
        megabytes=98,
        licence="BSD-3-Clause (torchvision); trained on ImageNet",
        description="ResNet-50 trained on ImageNet, 2048-d",
    ),
)

BY_NAME = {model.name: model for model in PUBLISHED}
