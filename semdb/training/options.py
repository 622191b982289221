"""What a training run is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from semdb.errors import UsageError
from semdb.perception.mask_rcnn import BACKBONES

EPOCHS = (4, 4, 8)
RATES = (0.001, 0.001, 0.0001)


@dataclass(frozen=True, slots=True)
class TrainOptions:
    """Options of `semdb.training.detector.train`; equal options and data make equal weights on one machine.

    `weights` is a spec (``torchvision:NAME`` or ``torchvision:PATH``) to start from, None for random weights on
    `backbone`, with so many `channels` in FPN and heads. `classes` None takes all of the data. `epochs` and `rates` are
    those of the three stages: heads; FPN and heads; all layers. `min_size`, `max_size` and `anchor` are None for those
    of the weights (800, 1333 and 32). `rois`: regions per image that the heads learn from. `decay` lets the rate of
    each stage fall along a cosine.
    """

    coco: Path
    output: Path
    split: str = "train"
    classes: tuple[str, ...] | None = None
    weights: str | None = "torchvision:maskrcnn_resnet50_fpn"
    backbone: str = "resnet50"
    min_size: int | None = None
    max_size: int | None = None
    anchor: int | None = None
    channels: int = 256
    epochs: tuple[int, int, int] = EPOCHS
    rates: tuple[float, float, float] = RATES
    batch: int = 2
    rois: int = 512
    decay: bool = False
    optimizer: str = "sgd"
    seed: int = 0
    save_every: int = 0  # steps between checkpoints; 0: after each epoch

    def __post_init__(self) -> None:
        """Raises UsageError naming the option that makes no sense."""
        if self.backbone not in BACKBONES:
            raise UsageError(f"--backbone {self.backbone}: known are {', '.join(BACKBONES)}")
        if self.optimizer not in ("sgd", "adamw"):
            raise UsageError(f"--optimizer {self.optimizer}: known are sgd and adamw")
        if min(self.epochs) < 0 or sum(self.epochs) < 1:
            raise UsageError(f"--epochs {self.epochs}: three numbers from 0, not all 0")
        if min(self.rates) <= 0:
            raise UsageError(f"--rates {self.rates}: three numbers above 0")
        limits = (("batch", 1, 1024), ("rois", 8, 4096), ("save_every", 0, 10**9), ("channels", 16, 1024))
        sizes = (("min_size", 32, 4096), ("max_size", 32, 8192), ("anchor", 4, 256))
        for name, low, high in limits + sizes:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise UsageError(f"--{name.replace('_', '-')} {value} is outside {low} to {high}")
