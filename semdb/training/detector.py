"""Training of Mask R-CNN in the paper's three stages, with checkpoints that a run goes on from exactly."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from semdb.errors import TrainingError, UsageError
from semdb.perception.detectors.torchvision import FORMAT
from semdb.perception.mask_rcnn import Architecture
from semdb.perception.torch_models import choose_device, import_torch, layer_precision, read_checkpoint
from semdb.settings import Settings
from semdb.shown import number
from semdb.training.coco import CocoData, load_coco
from semdb.training.options import TrainOptions
from semdb.training.samples import Sample, batches, epoch_order
from semdb.training.stages import Stage, enter, make_stages
from semdb.training.start import first_network

Progress = Callable[[int, int], None]  # steps, steps in all
CHECKPOINT, CURVES = "detector.pth", "curves.csv"
LOSSES = ("loss_classifier", "loss_box_reg", "loss_mask", "loss_objectness", "loss_rpn_box_reg")
_CLIP = 10.0  # norm of the gradient
_MOMENTUM, _WEIGHT_DECAY = 0.9, 1e-4


@dataclass(frozen=True, slots=True)
class Trained:
    """`checkpoint` is named in settings as ``torchvision:PATH``; `losses` are those of each step of this run."""

    checkpoint: Path
    curves: Path
    steps: int
    losses: tuple[float, ...]


@dataclass(slots=True)
class _Run:
    options: TrainOptions
    data: CocoData
    network: Any
    architecture: Architecture
    device: Any
    torch: Any
    step: int = 0  # done, over all stages
    losses: list[float] = field(default_factory=list)


def train(
    options: TrainOptions,
    settings: Settings,
    *,
    resume: bool = False,
    progress: Progress | None = None,
    stop_after: int | None = None,
    say: Callable[[str], None] | None = None,
) -> Trained:
    """Trains a detector on ``options.coco`` and writes `CHECKPOINT` and `CURVES` into ``options.output``.

    `resume` goes on from the checkpoint there, to the same weights as a run that was never cut off. `stop_after` ends
    the run after so many steps in all, with a checkpoint. Raises TrainingError for data or a checkpoint that cannot
    be used and for a loss that is not finite, UsageError when the output is there already, or not
    there to go on from, ModelError for the weights.
    """
    torch = import_torch()
    torch.set_num_threads(settings.threads)
    data = load_coco(options.coco, options.split, options.classes)
    if say is not None:
        for note in data.notes:
            say(note)
    if not any(picture.instances for picture in data.pictures):
        raise TrainingError(f"{data.file} shows no object of the classes {', '.join(data.classes[1:])}")
    path = options.output / CHECKPOINT
    if path.exists() and not resume:
        raise UsageError(f"{path} is there already: go on with --resume, or give another --output")
    if resume and not path.exists():
        raise UsageError(f"{path} is not there, so there is nothing to go on from: leave out --resume to begin")
    device = choose_device(settings.device, torch)
    network, architecture = first_network(options, data.classes, settings)
    options.output.mkdir(parents=True, exist_ok=True)
    run = _Run(options, data, network.to(device), architecture, device, torch)
    _limit_regions(network, options.rois)
    state = _read_state(path, run) if resume else None
    with _Curves(options.output / CURVES, run.step) as curves:
        _run_stages(run, state, curves, progress, stop_after)
    return Trained(path, options.output / CURVES, run.step, tuple(run.losses))


def _limit_regions(network: Any, rois: int) -> None:
    """The heads learn from `rois` regions of an image, drawn from 4 times as many, those from the best 16 times."""
    network.roi_heads.fg_bg_sampler.batch_size_per_image = rois
    for limits, most in ((network.rpn._post_nms_top_n, 4 * rois), (network.rpn._pre_nms_top_n, 16 * rois)):
        limits["training"] = min(limits["training"], most)


def _run_stages(
    run: _Run, state: dict[str, Any] | None, curves: _Curves, progress: Progress | None, stop_after: int | None
) -> None:
    stages = make_stages(run.options.epochs, run.options.rates)
    per_epoch = math.ceil(len(epoch_order(run.data, run.options.seed, 0)) / run.options.batch)
    total = per_epoch * sum(stage.epochs for stage in stages)
    end = total if stop_after is None else min(stop_after, total)
    if progress is not None:
        progress(run.step, total)
    first = 0  # step at which the stage begins
    for stage in stages:
        last = first + per_epoch * stage.epochs
        if run.step < min(last, end):
            enter(run.network, stage)
            optimizer, scaler = _optimizer(run, stage), _scaler(run)
            if state is not None:
                if run.step > first:
                    optimizer.load_state_dict(state["optimizer"])
                    scaler.load_state_dict(state["scaler"])
                _restore_random(run, state)
                state = None
            while run.step < min(last, end):
                epoch, done = divmod(run.step, per_epoch)
                for group in batches(run.data, run.options.batch, run.options.seed, epoch, done, run.torch):
                    rate = rate_at(stage, run.step - first, last - first, decay=run.options.decay)
                    losses = _learn(run, group, optimizer, scaler, rate)
                    run.step += 1
                    curves.write(run.step, epoch, stage, rate, losses)
                    if progress is not None:
                        progress(run.step, total)
                    every = run.options.save_every
                    if run.step == end or run.step % per_epoch == 0 or (every and run.step % every == 0):
                        _write_state(run, optimizer, scaler)
                    if run.step >= end:
                        break
        first = last


def rate_at(stage: Stage, step: int, steps: int, *, decay: bool) -> float:
    """The learning rate of a step of `stage`: a linear start over a tenth of it (at most 200), then constant.

    With `decay` it then falls along a cosine to a hundredth.
    """
    warm = min(200, max(1, steps // 10))
    if step < warm:
        return stage.rate * (step + 1) / warm
    if not decay:
        return stage.rate
    share = (step - warm) / max(1, steps - warm)
    return stage.rate * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * share)))


def _learn(run: _Run, group: Sequence[Sample], optimizer: Any, scaler: Any, rate: float) -> dict[str, float]:
    torch = run.torch
    for parameters in optimizer.param_groups:
        parameters["lr"] = rate
    images = [_on_device(image, run) for image, _ in group]
    targets = [{name: _on_device(value, run) for name, value in target.items()} for _, target in group]
    with layer_precision(run.device, torch):
        losses = run.network(images, targets)
        loss = sum(losses.values())
    value, *parts = torch.stack([loss.detach(), *(losses[name].detach() for name in LOSSES)]).tolist()
    if not math.isfinite(value):
        raise TrainingError(
            f"the loss is {value} at step {run.step + 1}: the learning rate ({number(rate)}) is too high, or the data "
            "have boxes that are none; the checkpoint of the last epoch is kept"
        )
    optimizer.zero_grad(set_to_none=True)
    scaler.scale(loss).backward()
    scaler.unscale_(optimizer)
    learning = [p for parameters in optimizer.param_groups for p in parameters["params"]]
    torch.nn.utils.clip_grad_norm_(learning, _CLIP)
    scaler.step(optimizer)
    scaler.update()
    run.losses.append(value)
    return {"loss": value, **dict(zip(LOSSES, parts, strict=True))}


def _on_device(tensor: Any, run: _Run) -> Any:
    return tensor.pin_memory().to(run.device, non_blocking=True) if run.device.type == "cuda" else tensor.to(run.device)


def _optimizer(run: _Run, stage: Stage) -> Any:
    learning = [p for p in run.network.parameters() if p.requires_grad]
    options: dict[str, Any] = {"lr": stage.rate, "weight_decay": _WEIGHT_DECAY}
    if run.device.type == "cpu":
        options["fused"] = True  # in one pass over memory: a tenth of a step's time on small images
    if run.options.optimizer == "adamw":
        return run.torch.optim.AdamW(learning, **options)
    return run.torch.optim.SGD(learning, momentum=_MOMENTUM, **options)


def _scaler(run: _Run) -> Any:
    """Keeps the small gradients of half precision from vanishing; does nothing but on CUDA."""
    return run.torch.amp.GradScaler(run.device.type, enabled=run.device.type == "cuda")


def _write_state(run: _Run, optimizer: Any, scaler: Any) -> None:
    """The checkpoint: a detector that can be used as it is, and all that the run needs to go on."""
    torch = run.torch
    random = {"cpu": torch.get_rng_state()}
    if run.device.type == "cuda":
        random["cuda"] = torch.cuda.get_rng_state(run.device)
    content = {
        "format": FORMAT,
        "architecture": asdict(run.architecture),
        "classes": list(run.data.classes),
        "model": run.network.state_dict(),
        "training": {
            "step": run.step,
            "optimizer": optimizer.state_dict(),
            "scaler": scaler.state_dict(),
            "random": random,
            "options": _comparable(run.options),
        },
    }
    path = run.options.output / CHECKPOINT
    new = path.with_name(path.name + ".new")
    torch.save(content, new)
    new.replace(path)


def _read_state(path: Path, run: _Run) -> dict[str, Any]:
    """Weights and step of the checkpoint go into `run`; returns what optimizer and random numbers go on from."""
    content = read_checkpoint(path)
    state = content.get("training")
    if content.get("format") != FORMAT or not isinstance(state, dict):
        raise TrainingError(f"{path} is no checkpoint of semdb train, so nothing can go on from it")
    if content["classes"] != list(run.data.classes):
        theirs, ours = (", ".join(names[1:]) for names in (content["classes"], run.data.classes))
        raise TrainingError(f"{path} was trained on the classes {theirs}, not on {ours}")
    options = _comparable(run.options)
    changed = [name for name, value in options.items() if state["options"].get(name) != value]
    if changed:
        raise TrainingError(f"{path} was made with other values of {', '.join(changed)}: resume with the same options")
    run.network.load_state_dict(content["model"])
    run.step = int(state["step"])
    return dict(state)


def _restore_random(run: _Run, state: dict[str, Any]) -> None:
    run.torch.set_rng_state(state["random"]["cpu"])
    if run.device.type == "cuda" and "cuda" in state["random"]:
        run.torch.cuda.set_rng_state(state["random"]["cuda"], run.device)


def _comparable(options: TrainOptions) -> dict[str, Any]:
    """What must be equal for a run to go on; where data and output lie may change."""
    kept = {n: v for n, v in asdict(options).items() if n not in ("coco", "output", "save_every", "classes")}
    return {name: list(value) if isinstance(value, tuple) else value for name, value in kept.items()}


class _Curves:
    """One line of CSV per step; those after `step`, of a run that was cut off, are written anew."""

    def __init__(self, path: Path, step: int) -> None:
        self._path, self._step = path, step
        self._started = time.perf_counter()

    def __enter__(self) -> _Curves:
        kept: list[list[str]] = []
        if self._step and self._path.exists():
            with self._path.open(newline="") as old:
                kept = [row for row in list(csv.reader(old))[1:] if row and int(row[0]) <= self._step]
        if kept:
            self._started -= float(kept[-1][-1])  # seconds of a run that went on are those of all of it
        self._file = self._path.open("w", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerow(["step", "epoch", "stage", "rate", "loss", *LOSSES, "seconds"])
        self._writer.writerows(kept)
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, step: int, epoch: int, stage: Stage, rate: float, losses: dict[str, float]) -> None:
        values = [number(losses[name]) for name in ("loss", *LOSSES)]
        seconds = f"{time.perf_counter() - self._started:.2f}"
        self._writer.writerow([step, epoch, stage.name, number(rate), *values, seconds])
        self._file.flush()
