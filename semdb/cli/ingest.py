"""`semdb ingest`: recordings become rows."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import CameraOption, JsonFlag, Overrides, settings_options

if TYPE_CHECKING:
    from semdb.ingest import IngestSummary


@settings_options(models=True)
def command(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH...", help="Folders of recordings.")],
    overrides: Overrides,
    map_name: Annotated[
        str | None,
        typer.Option("--map", metavar="M", help="World frame that the recordings share; default: one map each."),
    ] = None,
    name: Annotated[str | None, typer.Option("--name", metavar="N", help="Name of the recording in the map.")] = None,
    keyframes: Annotated[
        int | None, typer.Option("--keyframes", metavar="N", help="Exactly N keyframes, with the least common view.")
    ] = None,
    stride: Annotated[
        int | None, typer.Option("--stride", metavar="N", help="Every N-th usable frame instead of a selection.")
    ] = None,
    camera: CameraOption = None,
    json: JsonFlag = False,
) -> None:
    """Select keyframes, describe them and store them. Running it again adds nothing; cut off, it goes on."""
    from semdb.cli.output import print_json
    from semdb.cli.progress import StagedProgress, say
    from semdb.ingest import IngestOptions, ingest_recordings
    from semdb.recordings import parse_camera

    options = IngestOptions(
        map_name=map_name,
        name=name,
        keyframes=keyframes,
        stride=stride,
        camera=None if camera is None else parse_camera(camera),
    )
    with StagedProgress() as progress:
        summaries = ingest_recordings(paths, overrides.settings(), options, progress=progress.update, say=say)
    if json:
        print_json([as_json(summary) for summary in summaries])
    else:
        print("\n\n".join(as_text(summary) for summary in summaries))
    if any(summary.failed for summary in summaries):
        raise typer.Exit(1)


def as_json(summary: IngestSummary) -> dict[str, object]:
    """What `--json` prints for one recording."""
    return {
        "map": summary.map_name,
        "recording": summary.recording,
        "recording_id": summary.recording_id,
        "frames": summary.total_frames,
        "usable": summary.usable_frames,
        "keyframes": summary.planned,
        "already_stored": summary.already_stored,
        "stored": summary.stored,
        "failed": {str(index): reason for index, reason in summary.failed.items()},
        "objects": summary.objects,
        "keypoints": summary.keypoints,
        "dropped": [{"name": dropped.name, "reason": dropped.reason} for dropped in summary.dropped],
        "models": {model.role: model.name for model in summary.models},
        "notes": list(summary.notes),
        "seconds": summary.seconds,
    }


def as_text(summary: IngestSummary) -> str:
    """What is printed for people."""
    from semdb.cli.recording import group_dropped

    seconds = summary.seconds
    rate = f", {summary.stored / seconds['total']:.1f} keyframes/s" if summary.stored and seconds["total"] else ""
    stages = ", ".join(f"{name} {seconds[name]:.1f}" for name in ("read", "detect", "encode", "features", "store"))
    lines = [
        f"recording  {summary.recording} in map {summary.map_name}",
        f"frames     {summary.total_frames}, usable {summary.usable_frames}, dropped {len(summary.dropped)}",
        *(f"           {line}" for line in group_dropped(summary.dropped)),
        f"keyframes  {summary.planned} planned, {summary.stored} stored now, {summary.already_stored} stored before"
        f", {len(summary.failed)} failed",
        *(f"           frame {index}: {reason}" for index, reason in summary.failed.items()),
        f"objects    {summary.objects} with {summary.keypoints} keypoints in all",
        f"models     {', '.join(model.name for model in summary.models)}",
        f"seconds    {seconds['total']:.1f}{rate}; selection {seconds['select']:.1f}; {stages}",
    ]
    return "\n".join(lines)
