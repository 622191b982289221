"""Options that several commands share: settings as options, and names."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, cast

import typer

if TYPE_CHECKING:
    from semdb.api import Database
    from semdb.recordings.options import ReadOptions
    from semdb.settings import Settings
    from semdb.training.pose_options import PoseOptions

    Reading: TypeAlias = ReadOptions
else:
    Reading = Any  # `reading_options` puts options in its place, so typer never sees it

_PANEL = "Settings"

DatabaseUrl = Annotated[
    str | None,
    typer.Option("--database-url", metavar="URL", help="Database; over SEMDB_DATABASE_URL.", rich_help_panel=_PANEL),
]
Detector = Annotated[
    str | None,
    typer.Option("--detector", metavar="SPEC", help="Object detector; over SEMDB_DETECTOR.", rich_help_panel=_PANEL),
]
Encoder = Annotated[
    str | None,
    typer.Option("--encoder", metavar="SPEC", help="Place encoder; over SEMDB_ENCODER.", rich_help_panel=_PANEL),
]
Features = Annotated[
    str | None,
    typer.Option("--features", metavar="SPEC", help="Local features; over SEMDB_FEATURES.", rich_help_panel=_PANEL),
]
Device = Annotated[
    str | None,
    typer.Option("--device", metavar="NAME", help="Device of the networks; over SEMDB_DEVICE.", rich_help_panel=_PANEL),
]
Classes = Annotated[
    str | None,
    typer.Option(
        "--classes",
        metavar="NAMES",
        help="Keep objects of these classes only; over SEMDB_CLASSES.",
        rich_help_panel=_PANEL,
    ),
]
Dynamic = Annotated[
    str | None,
    typer.Option(
        "--dynamic",
        metavar="NAMES",
        help="Classes of objects that move: no keypoint lies on them; over SEMDB_DYNAMIC.",
        rich_help_panel=_PANEL,
    ),
]
CameraOption = Annotated[
    str | None,
    typer.Option(
        "--camera",
        metavar="fx,fy,cx,cy[,k1,k2,p1,p2,k3]",
        help="Intrinsics in pixels and lens distortion, instead of those known for the data set.",
    ),
]
AcceptOption = Annotated[
    str | None,
    typer.Option(
        "--accept",
        metavar="0.1m,5deg",
        help="Poses that differ by no more are one: ambiguous only if others fit as well.",
    ),
]

PoseBackboneOption = Annotated[
    str,
    typer.Option(
        "--pose-backbone",
        metavar="NAME",
        help="What networks that regress poses see with: frozen (the encoder, an onnx: file), resnet34, mobilenet_v2.",
    ),
]
PoseWeightsOption = Annotated[
    Path | None,
    typer.Option("--pose-weights", metavar="FILE", help="Checkpoint that the backbone starts from; default: random."),
]
PoseStepsOption = Annotated[
    int | None, typer.Option("--pose-steps", metavar="N", help="Steps of training of networks that regress poses.")
]


def pose_options(backbone: str, weights: Path | None, steps: int | None) -> PoseOptions:
    """How networks that regress poses are trained. Raises UsageError."""
    from semdb.training.pose_options import PoseOptions

    usual = PoseOptions(backbone=backbone, weights=weights)
    return usual if steps is None else replace(usual, steps=steps)


def accepted(text: str | None) -> tuple[float, float] | None:
    """Metres and degrees of ``0.1m,5deg``. Raises UsageError for other text."""
    from semdb.localization.acceptance import parse_tolerance

    if text is None:
        return None
    tolerance = parse_tolerance(text)
    return tolerance.metres, tolerance.degrees


_READING_PANEL = "How the recording is to be read"


def _reading(option: str, metavar: str, text: str) -> Any:
    kind = float if metavar in ("N", "MS") else str
    return Annotated[kind | None, typer.Option(option, metavar=metavar, help=text, rich_help_panel=_READING_PANEL)]


_READING = {
    "depth_scale": _reading("--depth-scale", "N", "Units per metre of depth files."),
    "poses_are": _reading("--poses-are", "WHAT", "world_from_camera (default) or camera_from_world."),
    "axes": _reading("--axes", "NAME", "Axes of the camera that the poses are of: opencv, opengl, arkit or ros."),
    "quaternion": _reading("--quaternion", "ORDER", "Order of the numbers of quaternions: xyzw or wxyz."),
    "time_offset_ms": _reading("--time-offset-ms", "MS", "Added to the times of poses to get those of colour."),
    "depth_offset_ms": _reading("--depth-offset-ms", "MS", "Added to the times of depth to get those of colour."),
    "times": _reading("--times", "HOW", "reversed: the poses run backwards through the times of colour."),
    "scale": _reading("--scale", "N", "Metres per unit of poses."),
    "up": _reading("--up", "X,Y,Z", "Up in the world of the poses, which becomes z; or 'cameras': where theirs is."),
    "depth_camera": _reading(
        "--depth-camera", "fx,fy,cx,cy[,x,y,z]", "Where depth is from, if not from the colour camera (place in metres)."
    ),
    "color_topic": _reading("--color-topic", "TOPIC", "Colour images of a ROS bag."),
    "depth_topic": _reading("--depth-topic", "TOPIC", "Depth images of a ROS bag."),
    "info_topic": _reading("--info-topic", "TOPIC", "camera_info of the colour camera of a ROS bag."),
    "world_frame": _reading("--world-frame", "FRAME", "World frame of a ROS bag's poses."),
}
JsonFlag = Annotated[bool, typer.Option("--json", help="Print JSON, and nothing else, on stdout.")]


@dataclass(frozen=True, slots=True)
class Overrides:
    """Settings given as options of one command; None where the environment or the default holds."""

    database_url: str | None = None
    detector: str | None = None
    encoder: str | None = None
    features: str | None = None
    device: str | None = None
    classes: str | None = None
    dynamic: str | None = None

    def settings(self, **more: object) -> Settings:
        """Settings of the environment under these options, and `more` of the command's own where they are not None.

        Raises `UsageError` naming the variable or option.
        """
        given = {field.name: getattr(self, field.name) for field in fields(self)} | more
        if self.database_url is not None:
            from semdb.cli.secrets import hide_password

            hide_password(self.database_url)
        return load_settings(**{name: value for name, value in given.items() if value is not None})


def open_database(settings: Settings) -> Database:
    """The database that a command goes through; what is assumed is said on stderr."""
    from semdb.api import Database
    from semdb.cli.progress import say

    return Database(settings, say=say)


def load_settings(**given: object) -> Settings:
    """`Settings` from the environment and `given`. Raises `UsageError` naming what is wrong where."""
    from semdb.settings import settings_with

    return settings_with(given, lambda name: f"--{name.replace('_', '-')}=")


_DATABASE = {"database_url": DatabaseUrl}
_MODELS = {
    **_DATABASE,
    "detector": Detector,
    "encoder": Encoder,
    "features": Features,
    "device": Device,
    "classes": Classes,
    "dynamic": Dynamic,
}


def settings_options(*, models: bool) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: the parameter ``overrides: Overrides`` of a command becomes the options that change settings.

    `models` False gives ``--database-url``; True adds those of ``_MODELS``: detector, encoder, …
    """
    return _options_instead_of("overrides", _MODELS if models else _DATABASE, lambda given: Overrides(**given))


def reading_options() -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: the parameter ``reading: ReadOptions`` of a command becomes the options of `ReadOptions`."""

    def make(given: dict[str, Any]) -> Any:
        from semdb.recordings.options import ReadOptions

        return ReadOptions(**{name: value for name, value in given.items() if value is not None})

    return _options_instead_of("reading", _READING, make)


def _options_instead_of(
    replaced: str, options: dict[str, Any], make: Callable[[dict[str, Any]], Any]
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: the parameter `replaced` becomes `options`, of whose values `make` makes it."""

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(function, eval_str=True)
        kept = [parameter for name, parameter in signature.parameters.items() if name != replaced]
        added = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
            for name, annotation in options.items()
        ]

        def call(**arguments: Any) -> None:
            given = {name: arguments.pop(name) for name in options}
            function(**arguments, **{replaced: make(given)})

        # typer reads a command's options from its signature
        new = signature.replace(parameters=[p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in kept] + added)
        command: Any = functools.wraps(function)(call)
        del command.__wrapped__
        command.__signature__ = new
        command.__annotations__ = {p.name: p.annotation for p in new.parameters.values()} | {"return": None}
        return cast(Callable[..., None], command)

    return decorate
