"""Training of a network that regresses poses in one place, with checkpoints that a run goes on from exactly."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError, TrainingError, UsageError
from semdb.perception.torch_models import choose_device, import_torch, load_weights, read_checkpoint, state_dict_of
from semdb.settings import Settings
from semdb.shown import number
from semdb.training.pose_network import as_floats, build, filtered, loss_of, single
from semdb.training.pose_options import PoseOptions
from semdb.training.pose_targets import PoseScale
from semdb.types import FloatArray, IntArray

FORMAT = "semdb-pose"
Progress = Callable[[int, int], None]  # steps, steps in all
_WEIGHT_DECAY = 5e-4
_LIGHT = (0.7, 1.3)
_NOISE = 0.5  # of the spread: poses that the LSTM learns from are better than those it will be given
_MANY = 64


@dataclass(frozen=True, slots=True, eq=False)
class PoseData:
    """What a network learns from.

    `inputs` ``[n, C, h, w]`` of all frames that are looked at. `windows` ``[m, W]`` are positions in `inputs`, of the
    frame that has the pose and, before it, of those that a filter sees too; `poses` ``[m, 4, 4]``, `names` ``[m]``.
    `encoder` is the SHA-256 of the network whose maps `inputs` are, "" where they are pixels.
    """

    inputs: npt.NDArray[Any]
    windows: IntArray
    poses: FloatArray
    names: tuple[str, ...]
    encoder: str = ""

    def digest(self) -> str:
        """Of which frames these are, and of their poses."""
        text = "\n".join(self.names).encode()
        return hashlib.sha256(text + self.poses.astype(np.float32).tobytes()).hexdigest()


class PoseRegressor:
    """A trained network: `frames` images to one pose."""

    def __init__(self, network: Any, options: PoseOptions, scale: PoseScale, device: Any, losses: list[float]) -> None:
        self._network, self._device = network.eval(), device
        self.options, self.scale, self.losses = options, scale, losses

    def predict(self, window: npt.NDArray[Any]) -> FloatArray:
        """``world_from_camera`` ``[4, 4]`` of the last of inputs ``[W, C, h, w]``. There always is one."""
        torch = import_torch()
        with torch.inference_mode():
            feature, pose = single(self._network, as_floats(torch.from_numpy(window).to(self._device)))
            if self.options.frames > 1:
                pose = filtered(self._network, feature[None], pose[None])
        target: FloatArray = pose[-1:].double().cpu().numpy()
        if not np.isfinite(target).all():
            raise ModelError(f"{self.options.kind} gave a pose that is not finite")
        answer: FloatArray = self.scale.poses(target)[0]
        return answer


def train(
    options: PoseOptions,
    data: PoseData,
    settings: Settings,
    *,
    checkpoint: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    stop_after: int | None = None,
) -> PoseRegressor:
    """Trains on `data`; `checkpoint` is written at the end, and where `stop_after` steps end the run.

    `resume` goes on from `checkpoint`, to the same weights as a run that was never cut off. Raises TrainingError for a
    loss that is not finite and a checkpoint of other frames, options or encoder, or a damaged one; UsageError for one
    that is there already, or not there to go on from, or cannot be written; ModelError without torch.
    """
    torch = import_torch()
    check_checkpoint(checkpoint, resume=resume)
    torch.set_num_threads(settings.threads)
    device = choose_device(settings.device, torch)
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        run = _Run(options, data, device)
        if resume and checkpoint is not None:
            run.restore(checkpoint)
        end = options.total_steps if stop_after is None else min(stop_after, options.total_steps)
        while run.step < end:
            run.learn()
            if progress is not None:
                progress(run.step, options.total_steps)
        if checkpoint is not None:
            run.save(checkpoint)
    return PoseRegressor(run.network, options, run.scale, device, run.losses)


def check_checkpoint(path: Path | None, *, resume: bool) -> None:
    """Makes the folder of a checkpoint. Raises UsageError where a run could not begin with it, go on or write it."""
    if path is not None and path.exists() and not resume:
        raise UsageError(f"{path} is there already: go on with --resume, or give another --output")
    if resume and (path is None or not path.exists()):
        raise UsageError(f"{path} is not there, so there is nothing to go on from: leave out --resume to begin")
    if path is not None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"{path} cannot be written: {error.strerror}: give another --output") from error


def load(path: Path, data: PoseData, options: PoseOptions, settings: Settings) -> PoseRegressor:
    """The network of a finished checkpoint, with the options that it was trained with.

    `data` are the frames that it must have been trained on; `options` say what kind it must be. Raises TrainingError.
    """
    torch = import_torch()
    torch.set_num_threads(settings.threads)
    content = _checked(path, data)
    own = _options(content, path)
    if own.kind != options.kind or own.backbone != options.backbone:
        raise TrainingError(f"{path} is {own.kind} on {own.backbone}, not {options.kind} on {options.backbone}")
    step = _step(content, path)
    if step < own.total_steps:
        raise TrainingError(f"{path} has {step} of {own.total_steps} steps: go on with semdb train pose --resume")
    device = choose_device(settings.device, torch)
    with torch.random.fork_rng(devices=[]):
        run = _Run(own, data, device)
    run.weights(content, path)
    return PoseRegressor(run.network, own, run.scale, device, run.losses)


class _Run:
    def __init__(self, options: PoseOptions, data: PoseData, device: Any) -> None:
        torch = import_torch()
        self.options, self.data, self.device, self.torch = options, data, device, torch
        torch.manual_seed(options.seed)
        self.scale = PoseScale.of(data.poses)
        self.network = build(options, data.inputs.shape[1:])
        self.network.spread.copy_(torch.from_numpy(self.scale.spread))
        self.network.to(device)
        self._wanted = torch.from_numpy(self.scale.targets(data.poses)).float().to(device)
        self._inputs = torch.from_numpy(data.inputs)
        self.step = 0
        self.losses: list[float] = []
        self._optimizer: Any = None
        self._single: tuple[Any, Any] | None = None

    def learn(self) -> None:
        """One step: of single images first, then of the filter. What is drawn depends on seed and step only."""
        torch, options = self.torch, self.options
        filtering = self.step >= options.steps
        if self.step in (0, options.steps) or self._optimizer is None:
            self._begin(filtering)
        rng = np.random.default_rng([options.seed, 20, self.step])
        torch.manual_seed(int(rng.integers(2**31)))
        count = len(self.data.windows)
        rows = rng.choice(count, min(options.batch, count), replace=False)
        rate = rate_at(options, self.step)
        for group in self._optimizer.param_groups:
            group["lr"] = rate
        self.network.train()
        found = self._filtered(rows) if filtering else self._found(rows, rng)
        loss = loss_of(self.network, found, self._wanted[torch.from_numpy(rows).to(self.device)])
        value = float(loss.detach())
        if not math.isfinite(value):
            raise TrainingError(f"the loss is {value} at step {self.step + 1}: the rate {number(rate)} is too high")
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self._learning, 5.0)
        self._optimizer.step()
        self.losses.append(value)
        self.step += 1

    def _begin(self, filtering: bool) -> None:
        of_filter = ("lstm", "residual")
        named = dict(self.network.named_parameters())
        self._learning = [
            value
            for name, value in named.items()
            if name == "log_variance" or (name.partition(".")[0] in of_filter) == filtering
        ]
        for value in named.values():
            value.requires_grad_(False)
        for value in self._learning:
            value.requires_grad_(True)
        self._optimizer = self.torch.optim.Adam(self._learning, weight_decay=_WEIGHT_DECAY)

    def _found(self, rows: npt.NDArray[np.intp], rng: np.random.Generator) -> Any:
        chosen = self._inputs[self.torch.from_numpy(self.data.windows[rows, -1].astype(np.int64))].to(self.device)
        light = self.torch.from_numpy(rng.uniform(*_LIGHT, len(rows)).astype(np.float32)).to(self.device)
        return single(self.network, as_floats(chosen, light))[1]

    def _filtered(self, rows: npt.NDArray[np.intp]) -> Any:
        """The first network stands still: what it says of every frame is computed once."""
        torch = self.torch
        if self._single is None:
            self.network.eval()
            with torch.no_grad():
                parts = [
                    single(self.network, as_floats(part.to(self.device))) for part in torch.split(self._inputs, _MANY)
                ]
            self._single = torch.cat([f for f, _ in parts]), torch.cat([p for _, p in parts])
        self.network.train()
        positions = torch.from_numpy(self.data.windows[rows].astype(np.int64)).to(self.device)
        features, poses = (values[positions] for values in self._single)
        return filtered(self.network, features, poses + _NOISE * self.network.spread * torch.randn_like(poses))

    def save(self, path: Path) -> None:
        content = {
            "format": FORMAT,
            "options": _plain(self.options),
            "frames": self.data.digest(),
            "encoder": self.data.encoder,
            "model": self.network.state_dict(),
            "optimizer": None if self._optimizer is None else self._optimizer.state_dict(),
            "step": self.step,
            "losses": self.losses,
        }
        try:
            new = path.with_name(path.name + ".new")
            with new.open("wb") as file:  # of a path torch says RuntimeError where it cannot be written
                self.torch.save(content, file)
            new.replace(path)
        except OSError as error:
            raise UsageError(f"{path} cannot be written: {error.strerror}") from error

    def restore(self, path: Path) -> None:
        content = _checked(path, self.data)
        if content.get("options") != _plain(self.options):
            raise TrainingError(f"{path} was made with other options: resume with the same ones")
        self.step = _step(content, path)
        self.weights(content, path)
        if 0 < self.step < self.options.total_steps and self.step != self.options.steps:
            self._begin(self.step >= self.options.steps)
            try:
                self._optimizer.load_state_dict(content["optimizer"])
            except (AttributeError, KeyError, TypeError, ValueError) as error:  # torch's, for what is no state
                raise _damaged(path) from error

    def weights(self, content: dict[str, Any], path: Path) -> None:
        """Takes the weights and losses of a checkpoint. Raises TrainingError, ModelError where they do not fit."""
        load_weights(self.network, state_dict_of(content, path), path, f"{self.options.kind} on these inputs")
        losses = content.get("losses")
        if not isinstance(losses, list) or not all(isinstance(loss, float) for loss in losses):
            raise _damaged(path)
        self.losses = list(losses)


def rate_at(options: PoseOptions, step: int) -> float:
    """The learning rate: falls along a cosine to a hundredth over the steps of each of the two stages."""
    first, steps = (0, options.steps) if step < options.steps else (options.steps, options.filter_steps)
    share = (step - first) / max(1, steps)
    return options.first_rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * share)))


def _checked(path: Path, data: PoseData) -> dict[str, Any]:
    content = read_checkpoint(path)
    if content.get("format") != FORMAT:
        raise TrainingError(f"{path} is no checkpoint of semdb train pose")
    if content.get("encoder", "") != data.encoder:
        raise TrainingError(
            f"{path} was trained on maps of another encoder: set SEMDB_ENCODER to the one that it was trained with, or "
            "train it anew"
        )
    if content.get("frames") != data.digest():
        raise TrainingError(
            f"{path} was trained on other frames than these keyframes and queries leave: give the same --keyframes and "
            "--max-queries, or train it anew"
        )
    return content


def _step(content: dict[str, Any], path: Path) -> int:
    step = content.get("step")
    if not isinstance(step, int) or step < 0:
        raise _damaged(path)
    return step


def _damaged(path: Path) -> TrainingError:
    return TrainingError(f"{path} is a damaged checkpoint of semdb train pose: delete it, and train it anew")


def _plain(options: PoseOptions) -> dict[str, Any]:
    values = asdict(options)
    return values | {"weights": None if options.weights is None else options.weights.name}


def _options(content: dict[str, Any], path: Path) -> PoseOptions:
    try:
        return PoseOptions(**(content["options"] | {"weights": None}))
    except (TypeError, KeyError, UsageError) as error:
        raise _damaged(path) from error
