"""Checkpoints with random weights in the formats that the publishers use."""

from __future__ import annotations

import pickle
import re
import struct
from collections import OrderedDict
from pathlib import Path
from typing import Any, ClassVar

import torch
import torchvision
from torchvision.ops import FrozenBatchNorm2d

from semdb.perception.mask_rcnn import Architecture, build

CHAIR = 62


def random_statistics(network: Any, seed: int) -> None:
    """Statistics of batch normalisation that are not those of a new network, so that ignoring them would show."""
    generator = torch.Generator().manual_seed(seed)
    for module in network.modules():
        if isinstance(module, (FrozenBatchNorm2d, torch.nn.BatchNorm2d)):
            module.running_mean.copy_(0.1 * torch.randn(module.running_mean.shape, generator=generator))
            module.running_var.copy_(0.5 + torch.rand(module.running_var.shape, generator=generator))


def mask_rcnn(architecture: Architecture, classes: int = 91, seed: int = 0) -> Any:
    """A network that calls much of an image a chair."""
    torch.manual_seed(seed)
    network = build(architecture, classes)
    random_statistics(network, seed)
    with torch.no_grad():
        if architecture.backbone == "resnet101":  # each of 33 blocks adds to what it is given: that would overflow
            for name, module in network.backbone.body.named_modules():
                if name.endswith("bn3"):
                    module.weight.mul_(0.3)
        head = network.roi_heads.box_predictor
        head.cls_score.weight.mul_(8)
        head.cls_score.bias[min(CHAIR, classes - 1)] += 3.0
        head.bbox_pred.weight.mul_(5)
        network.roi_heads.mask_predictor.mask_fcn_logits.weight.mul_(8)
    return network.eval()


def old_names(state: dict[str, Any]) -> OrderedDict[str, Any]:
    """The names that torchvision's first Mask R-CNN files have, without the counters that came later."""
    renamed: OrderedDict[str, Any] = OrderedDict()
    for name, value in state.items():
        if name.endswith("num_batches_tracked"):
            continue
        old = re.sub(r"(fpn\.(?:inner|layer)_blocks\.\d)\.0\.", r"\1.", name)
        old = old.replace("rpn.head.conv.0.0.", "rpn.head.conv.")
        for k in range(4):
            old = old.replace(f"roi_heads.mask_head.{k}.0.", f"roi_heads.mask_head.mask_fcn{k + 1}.")
        renamed[old] = value
    return renamed


def light(network: Any) -> Any:
    """`network` with few proposals and detections: a thousand of them take seconds on a CPU."""
    network.rpn._post_nms_top_n["testing"] = 40
    network.roi_heads.detections_per_img = 6
    return network


def write_places365(path: Path, outputs: int = 365, seed: int = 0, python2: bool = False) -> Any:
    """A file as the publisher of Places365 writes it, from DataParallel and in torch's first format; the network.

    `python2` as torch 0.2 wrote it on a GPU under Python 2, when those networks were trained.
    """
    torch.manual_seed(seed)
    network = torchvision.models.resnet50(weights=None, num_classes=outputs)
    random_statistics(network, seed)
    state = OrderedDict(
        (f"module.{name}", value)
        for name, value in network.state_dict().items()
        if not name.endswith("num_batches_tracked")  # the file is older than that counter
    )
    content = {"epoch": 90, "arch": "resnet50", "state_dict": state, "best_prec1": 54.77}
    if python2:
        save_as_python2(content, path)
    else:
        torch.save(content, path, _use_new_zipfile_serialization=False)
    return network.eval()


class _Python2Pickler(pickle._Pickler):
    """Pickles as Python 2 and torch 0.2: texts are byte strings, tensors have no hooks, storages lie on a GPU."""

    dispatch: ClassVar[dict[type, Any]] = dict(pickle._Pickler.dispatch)

    def __init__(self, file: Any) -> None:
        super().__init__(file, protocol=2)
        self.storages: dict[str, Any] = {}

    def save_text(self, text: str) -> None:
        data = text.encode("ascii")
        self.write(pickle.SHORT_BINSTRING + bytes([len(data)]) + data)
        self.memoize(text)

    dispatch[str] = save_text

    def persistent_id(self, value: Any) -> Any:
        if not isinstance(value, _Storage):
            return None
        key = str(139_000_000_000_000 + 64 * len(self.storages))  # an address
        self.storages[key] = value.tensor
        return ("storage", torch.cuda.FloatStorage, key, "cuda:0", value.tensor.numel(), None)

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, torch.Tensor):
            return torch._utils._rebuild_tensor, (_Storage(value), 0, tuple(value.shape), value.stride())
        if isinstance(value, OrderedDict):
            return OrderedDict, ([list(item) for item in value.items()],)
        return NotImplemented


class _Storage:
    def __init__(self, tensor: Any) -> None:
        self.tensor = tensor.contiguous()


def save_as_python2(content: dict[str, Any], path: Path) -> None:
    """The first format of torch: three pickles that say what it is, content, keys of the storages, their bytes."""
    with path.open("wb") as file:
        sizes = {"short": 2, "int": 4, "long": 4}
        for head in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True, "type_sizes": sizes}):
            _Python2Pickler(file).dump(head)
        pickler = _Python2Pickler(file)
        pickler.dump(content)
        keys = sorted(pickler.storages)
        _Python2Pickler(file).dump(keys)
        for key in keys:
            tensor = pickler.storages[key]
            file.write(struct.pack("<q", tensor.numel()) + tensor.numpy().tobytes())
