"""`semdb ingest`: recordings become rows."""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Annotated, cast

import typer

from semdb.cli.ending import ends_when_told
from semdb.cli.options import (
    CameraOption,
    JsonFlag,
    Overrides,
    Reading,
    open_database,
    reading_options,
    settings_options,
)
from semdb.shown import measure

FRAMES_SHOWN = 5

if TYPE_CHECKING:
    from collections.abc import Sequence

    from semdb.ingestion.queue import Send
    from semdb.ingestion.redescribe import Redescribed
    from semdb.ingestion.run import IngestSummary
    from semdb.settings import Settings
    from semdb.types import ModelInfo


@settings_options(models=True)
@reading_options()
def command(
    overrides: Overrides,
    reading: Reading,
    paths: Annotated[
        list[str] | None, typer.Argument(metavar="PATH...", help="Folders of recordings, or URLs such as s3://...")
    ] = None,
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
    batch: Annotated[
        str | None,
        typer.Option("--batch", metavar="N", help="Images at once through the networks; over SEMDB_BATCH."),
    ] = None,
    no_check: Annotated[
        bool,
        typer.Option("--no-check", help="Do not look first whether images fit what the recording says of itself."),
    ] = False,
    poses: Annotated[
        str,
        typer.Option("--poses", metavar="WHAT", help="recorded, estimated from images and depth, or auto (default)."),
    ] = "auto",
    align: Annotated[
        bool, typer.Option("--align", help="Find out where it lies in the map, and move it there.")
    ] = False,
    queue: Annotated[
        bool, typer.Option("--queue", help="Plan here, and let workers do it: see semdb.workers.")
    ] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Send all that is planned and not done to the workers again.")
    ] = False,
    redescribe: Annotated[
        str | None,
        typer.Option(
            "--redescribe", metavar="WHAT", help="encoder: describe the keyframes of --map, or of all maps, anew."
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="With --redescribe: only say what would be done.")] = False,
    json: JsonFlag = False,
) -> None:
    """Select keyframes, describe them and store them. Running it again adds nothing; cut off, it goes on."""
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import OF_TRAJECTORIES, StagedProgress
    from semdb.errors import UsageError
    from semdb.events import log_to
    from semdb.recordings.options import option_of

    settings = overrides.settings(batch=batch)
    if settings.log_format == "json":
        log_to()
    chosen = {
        "PATH": paths,
        "--map": map_name,
        "--name": name,
        "--keyframes": keyframes,
        "--stride": stride,
        "--camera": camera,
        "--align": align or None,
        "--poses": None if poses == "auto" else poses,
        **{option_of(name): value for name, value in reading.given().items()},
    }
    given = [word for word, value in chosen.items() if value not in (None, [])]
    if redescribe is not None:
        others = [word for word in given if word != "--map"] + ["--queue"] * queue + ["--resume"] * resume
        if others:
            raise UsageError(f"--redescribe is of a map's stored keyframes and takes no {', '.join(others)}")
        _redescribe(settings, redescribe, map_name, dry_run=dry_run, json=json)
        return
    if dry_run:
        raise UsageError("--dry-run is for --redescribe; `semdb recording PATH` says what a recording holds")
    if resume:
        if given:
            raise UsageError(
                f"--resume is of all recordings and takes no {', '.join(given)}: leave that out, or leave out --resume"
            )
        _resume(settings, json=json)
        return
    if not paths:
        raise UsageError("name the folder of a recording: semdb ingest PATH (or --resume for what workers have left)")
    if queue and align:
        raise UsageError("--align needs keyframes, which --queue leaves to workers: run semdb align when they are done")
    with StagedProgress(OF_TRAJECTORIES) as progress, ends_when_told(), open_database(settings) as database:
        work = partial(database.queue, paths, _send()) if queue else partial(database.ingest, paths, align=align)
        summaries = work(
            map=map_name,
            name=name,
            keyframes=keyframes,
            stride=stride,
            camera=camera,
            reading=reading,
            check=not no_check,
            poses=poses,
            progress=progress.update,
        )
    if queue and not json:
        print_lines(*(queued_text(summary) for summary in summaries))
    elif json:
        print_json([as_json(summary) for summary in summaries])
    else:
        for position, summary in enumerate(summaries):
            print_lines(*[""] * (position > 0), *as_lines(summary))
    lost = [summary for summary in summaries if summary.alignment is not None and not summary.alignment.convinced]
    if lost or any(summary.failed for summary in summaries):
        raise typer.Exit(1)


def _send() -> Send:
    """How keyframes are sent to workers. Raises UsageError without the worker extra."""
    from semdb.errors import UsageError

    try:
        workers = import_module("semdb.workers")
    except ImportError as error:
        raise UsageError(str(error)) from error
    return cast("Send", workers.send_items)


def _resume(settings: Settings, *, json: bool) -> None:
    from semdb.cli.output import print_json, print_lines

    with open_database(settings) as database:
        database.check()
        sent = database.resume(_send())
    if json:
        print_json({"sent": sent})
    else:
        print_lines(f"sent {sent} keyframes to the workers" if sent else "nothing is left to send")


def _redescribe(settings: Settings, what: str, map_name: str | None, *, dry_run: bool, json: bool) -> None:
    """Describes one map anew, or all that hold keyframes, one after the other; one that cannot be is named."""
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import StagedProgress, say
    from semdb.errors import DatabaseUnavailableError, SemdbError, UsageError

    if what != "encoder":
        raise UsageError(f"--redescribe {what}: what can be described anew is the encoder's vectors: encoder")
    done, failed = [], list[SemdbError]()
    with ends_when_told(), open_database(settings) as database:
        names = (
            [database.map(map_name).name] if map_name is not None else [m.name for m in database.maps() if m.keyframes]
        )
        for name in names:
            try:
                with StagedProgress() as progress:
                    done.append(database.redescribe(name, dry_run=dry_run, progress=progress.update))
            except SemdbError as error:
                if len(names) == 1 or isinstance(error, DatabaseUnavailableError):
                    raise
                failed.append(error)
                say(f"{name}: not described anew: {error}")
    if json:
        print_json([redescribed_json(one, dry_run=dry_run) for one in done])
    else:
        print_lines(*(redescribed_text(one, dry_run=dry_run) for one in done))
    if failed:
        raise typer.Exit(failed[0].exit_code)


def redescribed_json(done: Redescribed, *, dry_run: bool) -> dict[str, object]:
    """What `--redescribe --json` prints for one map."""
    return {"map": done.map_name, "dry_run": dry_run, **asdict(done), "switched": done.switched and not dry_run}


def redescribed_text(done: Redescribed, *, dry_run: bool) -> str:
    """What `--redescribe` prints for one map."""
    after = _encoder_text(done.after)
    if not done.described and not done.switched:
        return f"{done.map_name}: {done.keyframes} keyframes are described by {after}: nothing to do"
    verb = "would be described" if dry_run else "described"
    some = f", {done.recordings} of them from recordings" if done.recordings else ""
    before = f" in place of {_encoder_text(done.before)}" if done.switched else ""
    return f"{done.map_name}: {done.described} of {done.keyframes} keyframes {verb} by {after}{before}{some}"


def _encoder_text(model: ModelInfo) -> str:
    from semdb.perception.model_choice import crop_of_model

    crop = crop_of_model(model)
    return model.name if crop is None else f"{model.name}, crop {crop}"


def queued_text(summary: IngestSummary) -> str:
    """What `--queue` prints for one recording."""
    left = summary.planned - summary.already_stored
    return (
        f"{summary.map_name}/{summary.recording}: {summary.planned} keyframes planned, {summary.already_stored} "
        f"stored, {left} left to the workers; watch them: semdb status --watch"
    )


def as_json(summary: IngestSummary) -> dict[str, object]:
    """What `--json` prints for one recording."""
    from semdb.cli.align import as_json as alignment_json

    return {
        "map": summary.map_name,
        "recording": summary.recording,
        "recording_id": summary.recording_id,
        "poses": summary.pose_source,
        "alignment": None if summary.alignment is None else alignment_json(summary.alignment),
        "frames": summary.total_frames,
        "usable": summary.usable_frames,
        "keyframes": summary.planned,
        "already_stored": summary.already_stored,
        "stored": summary.stored,
        "stored_elsewhere": summary.elsewhere,
        "failed": {str(index): reason for index, reason in summary.failed.items()},
        "objects": summary.objects,
        "keypoints": summary.keypoints,
        "without_keypoints": summary.blank,
        "dropped": [{"name": dropped.name, "reason": dropped.reason} for dropped in summary.dropped],
        "remarks": [{"name": remark.name, "remark": remark.reason} for remark in summary.remarks],
        "models": {model.role: model.name for model in summary.models},
        "notes": list(summary.notes),
        "findings": [asdict(finding) for finding in summary.findings],
        "seconds": summary.seconds or None,
    }


def blank_text(frames: Sequence[int]) -> list[str]:
    """A line where keyframes show nothing."""
    if not frames:
        return []
    some = ", ".join(map(str, frames[:FRAMES_SHOWN])) + (", ..." if len(frames) > FRAMES_SHOWN else "")
    return [
        f"{len(frames)} without a keypoint (dark, blank or out of focus), nothing is matched with them: frame {some}"
    ]


def _described(summary: IngestSummary) -> list[str]:
    """A line where something was described now: of what was stored before, `semdb status` tells."""
    if not summary.stored:
        return []
    count = f"{summary.stored} keyframes" if summary.stored > 1 else "the keyframe"
    return [f"objects    {summary.objects}, and {summary.keypoints} keypoints, in {count} stored now"]


def as_lines(summary: IngestSummary) -> list[str]:
    """What is printed for people."""
    from semdb.cli.align import as_lines as alignment_lines
    from semdb.recordings.dropped import group_dropped

    alignment = [] if summary.alignment is None else alignment_lines(summary.alignment)
    seconds = summary.seconds
    rate = (
        f", {measure(summary.stored / seconds['total'], 1)} keyframes/s" if summary.stored and seconds["total"] else ""
    )
    stages = ", ".join(f"{name} {seconds[name]:.1f}" for name in ("read", "detect", "encode", "features", "store"))
    return [
        f"recording  {summary.recording} in map {summary.map_name}"
        + (", estimated poses" if summary.pose_source == "estimated" else ""),
        f"frames     {summary.total_frames}, usable {summary.usable_frames}, dropped {len(summary.dropped)}",
        *(f"           {line}" for line in group_dropped(summary.dropped)),
        f"keyframes  {summary.planned} planned, {summary.stored} stored now, {summary.already_stored} stored before"
        f", {len(summary.failed)} failed" + (f", {summary.elsewhere} by other processes" if summary.elsewhere else ""),
        *(f"           frame {index}: {reason}" for index, reason in summary.failed.items()),
        *(f"           {line}" for line in blank_text(summary.blank)),
        *(f"look at    {line}" for line in group_dropped(summary.remarks)),
        *_described(summary),
        f"models     {', '.join(model.name for model in summary.models)}",
        f"seconds    {seconds['total']:.1f}{rate}; selection {seconds['select']:.1f}; {stages}",
        *alignment,
    ]
