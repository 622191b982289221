"""What a network that regresses poses is made of, and how it is trained."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from semdb.errors import UsageError

POSENET, POSENET_4D, CNN_LSTM = "posenet", "posenet-4d", "cnn-lstm"
KINDS = (POSENET, POSENET_4D, CNN_LSTM)
FROZEN = "frozen"
BACKBONES = (FROZEN, "resnet34", "mobilenet_v2")
_RATES = {FROZEN: 5e-4}  # only a head learns: faster than the 1e-4 of MapNet for whole networks


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """Options of `semdb.training.pose.train`; equal options and frames make equal weights on one machine.

    `backbone` ``frozen`` takes the last map of the encoder of the settings, an ``onnx:`` file, as it is; the others
    are torchvision's and learn, from random weights or from the checkpoint `weights`. `steps` are those of the
    network of single images, `filter_steps` those of the LSTM behind it. For frozen features `rate` None is 0.0005 and
    `width` None 512 numbers before the pose, for the others 0.0001 and 2048. `window`: frames that the LSTM looks at,
    the one that is asked about last.
    """

    kind: str = POSENET
    backbone: str = FROZEN
    weights: Path | None = None
    steps: int = 800
    filter_steps: int = 300
    batch: int = 20
    rate: float | None = None
    width: int | None = None
    dropout: float = 0.5
    window: int = 10
    seed: int = 0

    def __post_init__(self) -> None:
        """Raises UsageError naming the option that makes no sense."""
        if self.kind not in KINDS:
            raise UsageError(f"--method {self.kind}: what learns poses is {', '.join(KINDS)}")
        if self.backbone not in BACKBONES:
            raise UsageError(f"--pose-backbone {self.backbone}: known are {', '.join(BACKBONES)}")
        if self.weights is not None and self.backbone == FROZEN:
            raise UsageError("--pose-weights: frozen features have the weights of the encoder; name a --pose-backbone")
        if self.steps < 1:
            raise UsageError(f"--pose-steps {self.steps}: at least one step is needed")

    @property
    def takes_depth(self) -> bool:
        return self.kind == POSENET_4D

    @property
    def frames(self) -> int:
        """How many images one pose is made of."""
        return self.window if self.kind == CNN_LSTM else 1

    @property
    def total_steps(self) -> int:
        return self.steps + (self.filter_steps if self.kind == CNN_LSTM else 0)

    @property
    def features(self) -> int:
        """How many numbers the pose is computed from."""
        return self.width or (512 if self.backbone == FROZEN else 2048)

    @property
    def first_rate(self) -> float:
        return _RATES.get(self.backbone, 1e-4) if self.rate is None else self.rate
