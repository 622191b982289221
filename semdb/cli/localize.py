"""`semdb localize`: images become camera poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import CameraOption, JsonFlag, Overrides, open_database, settings_options
from semdb.shown import measure

if TYPE_CHECKING:
    from semdb.api import Answer
    from semdb.errors import FrameError


@settings_options(models=True)
def command(
    images: Annotated[list[Path], typer.Argument(metavar="IMAGE...", help="Colour images.")],
    overrides: Overrides,
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="M", help="Map to look in; default: all maps.")
    ] = None,
    depth: Annotated[
        list[Path] | None,
        typer.Option("--depth", metavar="FILE", help="Depth image registered to the image; once per image."),
    ] = None,
    like: Annotated[
        str | None,
        typer.Option("--like", metavar="RECORDING", help="Recording (name or folder) whose camera took the images."),
    ] = None,
    camera: CameraOption = None,
    coarse: Annotated[
        str, typer.Option("--coarse", metavar="sql|index", help="Coarse step in SQL, or from a mirror in memory.")
    ] = "sql",
    plot: Annotated[Path | None, typer.Option("--plot", metavar="DIR", help="Write a picture per image.")] = None,
    json: JsonFlag = False,
) -> None:
    """Find the camera pose of images. A verdict of `failed` is an answer: exit code 0, no pose.

    An image that cannot be read is named on stderr and makes the exit code 1; the others are localized all the same.
    """
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import say

    settings = overrides.settings()
    if plot is not None:
        plot.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    pictures: set[Path] = set()
    broken: list[FrameError] = []

    def unreadable(error: FrameError) -> None:
        broken.append(error)
        say(str(error))

    with open_database(settings) as database:
        for answer in database.localize_each(
            images, map=map_name, depth=depth, camera=camera, like=like, coarse=coarse, unreadable=unreadable
        ):
            if json:
                results.append(answer.as_dict())
            else:
                print_lines(*as_lines(answer))
            if plot is not None:
                from semdb.pictures.localization import picture_path

                say(f"wrote {answer.save(picture_path(plot, answer.image, pictures))}")
    if json:
        print_json(results)
    if broken:
        raise typer.Exit(1)


def as_lines(answer: Answer) -> list[str]:
    """What is printed for people."""
    confidence = measure(answer.confidence, 2, unless=(0.0, 1.0))
    lines = [
        f"{answer.image}",
        f"  verdict     {answer.verdict} (confidence {confidence}): {answer.reason}",
    ]
    if answer.position is not None and answer.quat_wxyz is not None:
        position = " ".join(f"{value:.4f}" for value in answer.position)
        quaternion = " ".join(f"{value:.5f}" for value in answer.quat_wxyz)
        lines += [
            f"  position    {position} m in map {answer.map}{_sigma(answer.covariance)}",
            f"  quat_wxyz   {quaternion}",
        ]
    named = [f"{c.recording}/{c.frame_index} ({c.inliers})" for c in answer.candidates]
    spent = ", ".join(f"{stage} {value:.0f}" for stage, value in answer.timing_ms.items())
    return [
        *lines,
        f"  candidates  {', '.join(named) or 'none'} (inliers), stage {answer.stage}",
        f"  ms          {spent}",
    ]


def _sigma(covariance: Any) -> str:
    if covariance is None:
        return ""
    sigma_m = float(max(covariance[i, i] for i in range(3))) ** 0.5
    return f" +- {measure(1000 * sigma_m, 1)} mm"
