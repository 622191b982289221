"""`semdb train`: fine-tune the networks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, TypeVar

import typer

from semdb.cli.options import (
    PoseBackboneOption,
    PoseStepsOption,
    PoseWeightsOption,
    load_settings,
    pose_options,
)
from semdb.cli.output import print_lines
from semdb.errors import UsageError

_Number = TypeVar("_Number", int, float)

command = typer.Typer(help="Train the networks.", no_args_is_help=True, add_completion=False, rich_markup_mode=None)


@command.callback()
def group() -> None:
    """Train the networks."""


@command.command("detector")
def train_detector(
    coco: Annotated[
        Path, typer.Option(metavar="DIR", help="COCO-format data: annotations/instances_SPLIT.json, SPLIT/.")
    ],
    output: Annotated[Path, typer.Option(metavar="DIR", help="Folder for checkpoint and curves.")],
    split: Annotated[str, typer.Option(help="Split to learn from.")] = "train",
    classes: Annotated[str, typer.Option(metavar="NAMES", help="Classes divided by commas, indoor or all.")] = "all",
    weights: Annotated[
        str, typer.Option(metavar="SPEC", help="torchvision:NAME or :PATH to start from, or none.")
    ] = "torchvision:maskrcnn_resnet50_fpn",
    backbone: Annotated[str, typer.Option(help="ResNet to start at random, with --weights none.")] = "resnet50",
    min_size: Annotated[int | None, typer.Option(help="Shorter side that images are resized to, pixels.")] = None,
    max_size: Annotated[int | None, typer.Option(help="Longest side of resized images, pixels.")] = None,
    anchor: Annotated[int | None, typer.Option(help="Side of the smallest anchors, pixels.")] = None,
    channels: Annotated[int, typer.Option(help="Channels of FPN and heads, with --weights none.")] = 256,
    epochs: Annotated[str, typer.Option(metavar="H,F,A", help="Epochs: heads; FPN and heads; all layers.")] = "4,4,8",
    rates: Annotated[str, typer.Option(metavar="H,F,A", help="Learning rates of the stages.")] = "0.001,0.001,0.0001",
    batch: Annotated[int, typer.Option(help="Images per step.")] = 2,
    rois: Annotated[int, typer.Option(help="Regions per image that the heads learn from.")] = 512,
    decay: Annotated[bool, typer.Option("--decay", help="Let the rate of each stage fall along a cosine.")] = False,
    optimizer: Annotated[str, typer.Option(help="sgd or adamw.")] = "sgd",
    seed: Annotated[int, typer.Option(help="Order, changes of images and random weights.")] = 0,
    save_every: Annotated[int, typer.Option(help="Steps between checkpoints; 0: after each epoch.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the checkpoint in --output.")] = False,
    device: Annotated[str | None, typer.Option(metavar="NAME", help="Device; over SEMDB_DEVICE.")] = None,
) -> None:
    """Train Mask R-CNN on COCO-format data in three stages: heads; FPN and heads; all layers.

    The checkpoint is a detector: name it as torchvision:PATH.
    """
    from semdb.cli.progress import Progress, say
    from semdb.training.detector import CHECKPOINT, train
    from semdb.training.options import TrainOptions

    options = TrainOptions(
        coco=coco,
        output=output,
        split=split,
        classes=classes_of(coco, split, classes),
        weights=None if weights == "none" else weights,
        backbone=backbone,
        min_size=min_size,
        max_size=max_size,
        anchor=anchor,
        channels=channels,
        epochs=_three(epochs, "epochs", int),
        rates=_three(rates, "rates", float),
        batch=batch,
        rois=rois,
        decay=decay,
        optimizer=optimizer,
        seed=seed,
        save_every=save_every,
    )
    settings = load_settings(**({} if device is None else {"device": device}))
    try:
        with Progress("training", unit="steps") as progress:
            done = train(options, settings, resume=resume, progress=progress.go_on, say=say)
    except KeyboardInterrupt:
        if (output / CHECKPOINT).exists():
            say(f"{output / CHECKPOINT} is kept: the same command with --resume goes on from it")
        raise
    last = f", loss {sum(done.losses[-20:]) / len(done.losses[-20:]):.3f}" if done.losses else ""
    print_lines(f"{done.steps} steps{last}; curves in {done.curves}; use the detector as torchvision:{done.checkpoint}")


@command.command("pose")
def train_pose(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Folders of recordings.")],
    output: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the networks; see evaluate --pose-networks.")],
    method: Annotated[
        list[str] | None,
        typer.Option(
            "--method", metavar="NAME", help="posenet (default), posenet-4d, cnn-lstm, or NAME-keyframes; several."
        ),
    ] = None,
    keyframes: Annotated[int | None, typer.Option(metavar="N", help="As for the evaluation.")] = None,
    max_queries: Annotated[int | None, typer.Option(metavar="N", help="As for the evaluation.")] = None,
    pose_backbone: PoseBackboneOption = "frozen",
    pose_weights: PoseWeightsOption = None,
    pose_steps: PoseStepsOption = None,
    encoder: Annotated[str | None, typer.Option(metavar="SPEC", help="Place encoder; over SEMDB_ENCODER.")] = None,
    device: Annotated[str | None, typer.Option(metavar="NAME", help="Device; over SEMDB_DEVICE.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the networks in --output.")] = False,
) -> None:
    """Train networks that regress poses in the places of recordings, on frames that an evaluation does not ask about.

    Keyframes and queries are chosen as `semdb evaluate` does with the same options.
    """
    from semdb.cli.progress import StagedProgress, say
    from semdb.evaluation.regression import PoseTraining, train_networks

    given = {name: value for name, value in (("encoder", encoder), ("device", device)) if value is not None}
    settings = load_settings(**given)
    training = PoseTraining(pose_options(pose_backbone, pose_weights, pose_steps), output)
    with StagedProgress() as progress:
        found = train_networks(
            paths, tuple(method or ["posenet"]), training, settings, keyframes=keyframes, max_queries=max_queries,
            resume=resume, progress=progress.update, say=say,
        )  # fmt: skip
        lines = [
            f"{path}: {network.frames} frames, loss {sum(tail) / max(1, len(tail)):.3f}"
            for path, network in found
            for tail in (network.regressor.losses[-20:],)
        ]
    print_lines(*lines)


def classes_of(coco: Path, split: str, text: str) -> tuple[str, ...] | None:
    """The classes named by `text`, None for ``all``; ``indoor`` are those of the list that the data have."""
    from semdb.perception.detectors.coco import INDOOR
    from semdb.training.coco import load_coco

    if text == "all":
        return None
    names: dict[str, None] = {}
    for word in filter(None, (part.strip() for part in text.split(","))):
        known = load_coco(coco, split).classes if word == "indoor" else ()
        names.update(dict.fromkeys([name for name in INDOOR if name in known] if word == "indoor" else [word]))
    if not names:
        raise UsageError(f"--classes {text!r} names no class of the data")
    return tuple(names)


def _three(text: str, name: str, kind: Callable[[str], _Number]) -> tuple[_Number, _Number, _Number]:
    try:
        first, second, third = (kind(part) for part in text.split(","))
    except ValueError:
        raise UsageError(f"--{name} {text}: three numbers divided by commas, for heads, FPN, all layers") from None
    return first, second, third
