"""`semdb localize`: images become camera poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import CameraOption, JsonFlag, Overrides, settings_options
from semdb.shown import measure

if TYPE_CHECKING:
    from semdb.errors import FrameError
    from semdb.localization.images import ImageLocalization


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
    from semdb.database.store import open_store
    from semdb.localization.images import LocalizeOptions, localize_images
    from semdb.recordings import parse_camera

    settings = overrides.settings()
    options = LocalizeOptions(map_name, None if camera is None else parse_camera(camera), like, coarse)
    if plot is not None:
        plot.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    pictures: set[Path] = set()
    broken: list[FrameError] = []

    def unreadable(error: FrameError) -> None:
        broken.append(error)
        say(str(error))

    with open_store(settings.database_url, say=say) as store:
        for answer in localize_images(images, depth or [], store, settings, options, say=say, unreadable=unreadable):
            if json:
                results.append(as_json(answer))
            else:
                print_lines(*as_lines(answer))
            if plot is not None:
                from semdb.pictures.localization import write_picture

                say(f"wrote {write_picture(plot, store, answer, pictures)}")
    if json:
        print_json(results)
    if broken:
        raise typer.Exit(1)


def as_json(answer: ImageLocalization) -> dict[str, Any]:
    """One object of the array that `--json` prints."""
    from semdb.geometry import quat_wxyz_from_rotation

    found = answer.localization
    pose = found.world_from_camera
    return {
        "image": str(answer.query.path),
        "verdict": str(found.verdict),
        "map": found.map_name,
        "pose": None
        if pose is None
        else {"position": pose[:3, 3].tolist(), "quat_wxyz": quat_wxyz_from_rotation(pose[:3, :3]).tolist()},
        "covariance": None if found.covariance is None else found.covariance.tolist(),
        "confidence": found.confidence,
        "inliers": found.inliers,
        "stage": found.stage,
        "reason": found.reason,
        "ranked_share": found.ranked_share,
        "keyframes_matched": found.keyframes_matched,
        "candidates": [
            {
                "keyframe": candidate.keyframe_id,
                "recording": candidate.recording,
                "frame_index": candidate.frame_index,
                "class_score": candidate.class_score,
                "cosine": candidate.cosine,
                "inliers": candidate.inliers,
            }
            for candidate in found.candidates
        ],
        "refinements": dict(found.refinements),
        "timing_ms": dict(found.timing_ms),
    }


def as_lines(answer: ImageLocalization) -> list[str]:
    """What is printed for people."""
    from semdb.geometry import quat_wxyz_from_rotation

    found = answer.localization
    lines = [
        f"{answer.query.path}",
        f"  verdict     {found.verdict} (confidence {measure(found.confidence, 2, unless=(0.0, 1.0))}): {found.reason}",
    ]
    if found.world_from_camera is not None:
        position = " ".join(f"{value:.4f}" for value in found.world_from_camera[:3, 3])
        quaternion = " ".join(f"{value:.5f}" for value in quat_wxyz_from_rotation(found.world_from_camera[:3, :3]))
        lines += [
            f"  position    {position} m in map {found.map_name}{_sigma(found.covariance)}",
            f"  quat_wxyz   {quaternion}",
        ]
    named = [f"{c.recording}/{c.frame_index} ({c.inliers})" for c in found.candidates]
    spent = ", ".join(f"{stage} {value:.0f}" for stage, value in found.timing_ms.items())
    return [
        *lines,
        f"  candidates  {', '.join(named) or 'none'} (inliers), stage {found.stage}",
        f"  ms          {spent}",
    ]


def _sigma(covariance: Any) -> str:
    if covariance is None:
        return ""
    sigma_m = float(max(covariance[i, i] for i in range(3))) ** 0.5
    return f" +- {measure(1000 * sigma_m, 1)} mm"
