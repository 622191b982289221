"""`semdb recording`: what was recognised, and what cannot be used and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import CameraOption, JsonFlag, Reading, reading_options
from semdb.shown import measure, number

if TYPE_CHECKING:
    from semdb.evaluation.pose_comparison import PoseComparison
    from semdb.recordings import Recording
    from semdb.recordings.check import Report
    from semdb.types import Camera


@reading_options()
def command(
    path: Annotated[Path, typer.Argument(help="Folder or file of a recording, or folder of a scene with several.")],
    reading: Reading,
    camera: CameraOption = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Do not decode every image; look at headers and file ends only.")
    ] = False,
    check: Annotated[
        bool,
        typer.Option("--check", help="Compare poses, depth, intrinsics, clocks with the images; 1 if wrong."),
    ] = False,
    trajectory: Annotated[
        bool,
        typer.Option("--trajectory", help="With --check: compare all poses with those that images and depth give."),
    ] = False,
    json: JsonFlag = False,
) -> None:
    """Say what a recording holds and which frames cannot be used.

    Every image is decoded, so that broken ones are found.
    """
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import Progress
    from semdb.errors import UsageError
    from semdb.recordings import open_recordings, parse_camera
    from semdb.recordings.focus import watched

    if trajectory and not check:
        raise UsageError("--trajectory compares poses while a recording is checked: give --check too")
    with Progress(f"looking at the files of {path.name}", unit="files") as progress, watched(progress.update):
        recordings = open_recordings(path, None if camera is None else parse_camera(camera), reading)
    if not quick and not check:
        for recording in recordings:
            decode_all(recording)
    reports = [look(recording) if check else None for recording in recordings]
    compared = [compare(recording) if trajectory else None for recording in recordings]
    every = list(zip(recordings, reports, compared, strict=True))
    if json:
        print_json([as_json(r, quick or check, report) | comparison_json(poses) for r, report, poses in every])
    else:
        for position, (recording, report, poses) in enumerate(every):
            lines = [*as_lines(recording, quick or check), *check_lines(report), *comparison_lines(poses)]
            print_lines(*[""] * (position > 0), *lines)
    if any(finding.certain for report in reports if report is not None for finding in report.findings):
        raise typer.Exit(1)


def look(recording: Recording) -> Report:
    """Compares what the recording says of itself with its images."""
    from semdb.cli.progress import Progress
    from semdb.recordings.check import check_recording

    with Progress(f"checking {recording.name}") as progress:
        return check_recording(recording, progress=progress.update)


def check_lines(report: Report | None) -> list[str]:
    """What `--check` adds for people."""
    if report is None:
        return []
    rows = [("checked", f"{report.pairs} pairs of frames")]
    if report.error_px == report.error_px:
        rows[0] = ("checked", f"{rows[0][1]}; matches are {report.error_px:.1f} px of 640 off")
    rows += [("", note) for note in report.notes]
    for finding in report.findings:
        mend = f"; {finding.option}" if finding.option else ""
        rows.append(("certain" if finding.certain else "likely", f"{finding.message}{mend}"))
    if not report.findings and report.floor_px == report.floor_px:
        rows.append(("", "nothing contradicts the images"))
    return [f"{label:<12} {text}" for label, text in rows]


def compare(recording: Recording) -> PoseComparison | str:
    """Recorded poses beside estimated ones, or why there is nothing to compare."""
    from semdb.cli.progress import OF_TRAJECTORIES, StagedProgress
    from semdb.errors import RecordingError
    from semdb.evaluation.pose_comparison import compare_poses
    from semdb.trajectory.recording import find_recorded

    if all(entry.world_from_camera is None for entry in recording.entries):
        return "no poses are recorded: semdb trajectory estimates them"
    try:
        with StagedProgress(OF_TRAJECTORIES) as progress:
            return compare_poses(find_recorded(recording, progress=progress.update))
    except RecordingError as error:
        return str(error)


def comparison_lines(found: PoseComparison | str | None) -> list[str]:
    """What `--trajectory` adds for people."""
    if found is None:
        return []
    if isinstance(found, str):
        return [f"{'estimated':<12} {found}"]
    rows = [("estimated", f"{found.estimated} poses, {found.frames} of them recorded too; pieces: {found.pieces}")]
    errors = found.errors
    if errors is not None:
        off, median, most = (measure(value, 4) for value in (errors.rmse_m, errors.median_m, errors.max_m))
        rows += [
            (
                "",
                f"recorded: {off} m RMSE, {median} m median off, at most {most} m (frame {found.worst_frame})",
            ),
            ("", f"{found.rotation_deg:.2f} deg median; the recorded path is {found.scale:.4f} times as large"),
            ("", f"(estimated positions are sure to {measure(found.sigma_m, 4)} m)"),
        ]
    return [f"{label:<12} {text}" for label, text in rows]


def no_poses(found: Mapping[str, Any]) -> str:
    """What is to be said of a recording without poses; `found` are its counts."""
    if not found["with_depth"]:
        return "no poses, and no depth that they could be estimated from"
    return "no poses: `semdb ingest` estimates them from images and depth, `semdb trajectory` alone, too"


def comparison_json(found: PoseComparison | str | None) -> dict[str, Any]:
    """What `--trajectory --json` adds: metres and degrees, null where they are not known."""
    if found is None:
        return {}
    return {"trajectory": {"problem": found} if isinstance(found, str) else {"problem": None, **asdict(found)}}


def decode_all(recording: Recording) -> None:
    """Decode every usable frame; those that fail go to `recording.decode_failures`, strange ones to its `remarks`."""
    from semdb.cli.progress import Progress
    from semdb.errors import FrameError

    with Progress(f"decoding {recording.name}") as progress:
        for done, entry in enumerate(recording.entries, 1):
            try:
                recording.note_remarks(recording.read(entry))
            except FrameError as error:
                recording.note_decode_failure(entry, error)
            progress.update(done, len(recording.entries))


def counts(recording: Recording) -> dict[str, int]:
    """Frames, those that can be used, and how many of these have what."""
    broken = {failure.name for failure in recording.decode_failures}
    usable = [entry for entry in recording.entries if entry.name not in broken]
    return {
        "frames": recording.total_frames,
        "usable": len(usable),
        "triples": sum(e.depth_path is not None and e.world_from_camera is not None for e in usable),
        "with_depth": sum(entry.depth_path is not None for entry in usable),
        "with_pose": sum(entry.world_from_camera is not None for entry in usable),
        "with_masks": sum(entry.masks_path is not None for entry in usable),
    }


def as_json(recording: Recording, quick: bool, report: Report | None = None) -> dict[str, Any]:
    """What `--json` prints for one recording."""
    camera = recording.camera
    return {
        "path": str(recording.path),
        "name": recording.name,
        "format": recording.format,
        **counts(recording),
        "decoded": not quick,
        "dropped": [
            {"name": dropped.name, "reason": dropped.reason}
            for dropped in (*recording.dropped, *recording.decode_failures)
        ],
        "remarks": [{"name": remark.name, "remark": remark.reason} for remark in recording.remarks],
        "camera": {
            "model": camera.model,
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "distortion": list(camera.distortion),
        },
        "depth_scale": recording.depth_scale,
        "depth_registration": recording.depth_registration,
        "trajectory_length_m": recording.trajectory_length(),
        "notes": list(recording.notes),
        "contents": list(recording.contents),
        **({} if report is None else check_json(report)),
        "assumed": list(recording.assumed),
    }


def check_json(report: Report) -> dict[str, Any]:
    """What `--check --json` adds; errors are in pixels of an image of 640, null where they are not known."""
    return {
        "findings": [asdict(finding) for finding in report.findings],
        "checked_pairs": report.pairs,
        "error_px": report.error_px,
        "floor_px": report.floor_px,
        "not_checked": list(report.notes),
    }


def as_lines(recording: Recording, quick: bool) -> list[str]:
    """What is printed for people."""
    from semdb.recordings.dropped import group_dropped

    found = counts(recording)
    dropped = (*recording.dropped, *recording.decode_failures)
    triples = f"{found['triples']} with colour, depth and pose"
    if found["triples"] != found["usable"]:
        triples += f"; {found['with_depth']} with depth, {found['with_pose']} with a pose"
    registered = f", registered to colour ({recording.depth_registration})" if recording.depth_registration else ""
    rows = [
        ("recording", f"{recording.name} ({recording.format}) in {recording.path}"),
        ("frames", f"{found['frames']}, usable {found['usable']} ({triples})"),
        ("dropped", f"{len(dropped)}{' (not every image was decoded)' if quick else ''}"),
        *(("", line) for line in group_dropped(dropped)),
        *(("look at", line) for line in group_dropped(recording.remarks)),
        ("camera", describe_camera(recording.camera)),
        ("depth scale", f"{number(recording.depth_scale)} per metre{registered}"),
        ("masks", f"{found['with_masks']} frames" if found["with_masks"] else "none"),
        ("trajectory", f"{measure(recording.trajectory_length(), 2)} m" if found["with_pose"] else no_poses(found)),
        *(("holds", line) for line in recording.contents),
        *(("note", note) for note in recording.notes if note not in recording.assumed),
        *(("assumed", line) for line in recording.assumed),
    ]
    return [f"{label:<12} {text}" for label, text in rows]


def describe_camera(camera: Camera) -> str:
    """One line: size, intrinsics in pixels, distortion."""
    intrinsics = ", ".join(f"{name} {number(getattr(camera, name))}" for name in ("fx", "fy", "cx", "cy"))
    text = f"{camera.width}x{camera.height}, {intrinsics}"
    if camera.model == "PINHOLE":
        return f"{text}, no distortion"
    return f"{text}, distortion {', '.join(map(number, camera.distortion))}"
