"""The network that a training run starts with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from semdb.perception import mask_rcnn
from semdb.perception.detectors.torchvision import known_architecture, load_detector_checkpoint
from semdb.perception.mask_rcnn import Architecture
from semdb.perception.torch_models import import_torch, resolve_checkpoint
from semdb.settings import Settings
from semdb.training.options import TrainOptions


def first_network(options: TrainOptions, classes: tuple[str, ...], settings: Settings) -> tuple[Any, Architecture]:
    """The network for `classes` (the background first) and what it is.

    From weights: all layers are kept, and of the last ones what belongs to classes of the same name; the others start
    at random. Raises ModelError when the weights are not there or are no Mask R-CNN.
    """
    torch = import_torch()
    torch.manual_seed(options.seed)
    given = {n: v for n in ("min_size", "max_size", "anchor") if (v := getattr(options, n)) is not None}
    if options.weights is None:
        architecture = replace(Architecture(options.backbone, channels=options.channels), **given)
        return mask_rcnn.build(architecture, len(classes), frozen=False), architecture
    path = resolve_checkpoint(options.weights, settings)
    source, architecture, known = load_detector_checkpoint(path, known_architecture(options.weights))
    architecture = replace(architecture, **given)
    network = mask_rcnn.build(architecture, len(classes))
    adopt(network, source.state_dict(), classes, known, torch)
    return network, architecture


def adopt(network: Any, source: dict[str, Any], classes: Sequence[str], known: Sequence[str], torch: Any) -> None:
    """Copies the weights `source`, of a network for the classes `known`, into `network` for `classes`.

    Rows of the last layers are copied by name of class; those of new classes stay as `network` has them.
    """
    names = {name: k for k, name in enumerate(known)}
    pairs = [(new, names[name]) for new, name in enumerate(classes) if name in names]
    pairs[:0] = [] if any(new == 0 for new, _ in pairs) else [(0, 0)]  # the background goes by several names
    target = network.state_dict()
    with torch.no_grad():
        for name, value in target.items():
            if ".box_predictor." in name or ".mask_fcn_logits." in name:
                per_class = 4 if "bbox_pred" in name else 1
                for new, old in pairs:
                    rows = slice(new * per_class, (new + 1) * per_class)
                    value[rows] = source[name][old * per_class : (old + 1) * per_class]
            elif name in source:
                value.copy_(source[name])
    network.load_state_dict(target)
