"""`semdb trajectory`: where the camera went, from images and depth alone."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from semdb.cli.options import CameraOption, Encoder, Reading, reading_options
from semdb.shown import measure

if TYPE_CHECKING:
    from semdb.perception.protocols import Encoder as PlaceEncoder
    from semdb.pictures.trajectory import ShownClosure
    from semdb.recordings.base import Recording
    from semdb.trajectory.recording import RecordedTrajectory

REASONS_SHOWN = 5


@reading_options()
def command(
    path: Annotated[Path, typer.Argument(help="Folder or file of a recording with colour and depth.")],
    reading: Reading,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write the poses of all frames in TUM's format.")
    ] = None,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write poses, covariances, edges and counts as JSON.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", metavar="DIR", help="Draw the path from above before and after closing.")
    ] = None,
    every: Annotated[int, typer.Option("--every", metavar="N", help="Take every N-th frame only.")] = 1,
    encoder: Encoder = None,
    camera: CameraOption = None,
) -> None:
    """Find the trajectory of a recording from its images and depth, whether it has poses or not.

    No model file is needed; a place encoder may be given to propose loop closures.
    """
    from semdb.cli.progress import OF_TRAJECTORIES, StagedProgress, say
    from semdb.recordings import open_recording, parse_camera
    from semdb.recordings.dropped import lines_of_opening
    from semdb.trajectory.recording import find_recorded

    recording = open_recording(path, None if camera is None else parse_camera(camera), reading)
    check_outputs(out, json_file, plot)
    for line in lines_of_opening(recording):
        say(line)
    chosen = encoder_of(encoder)
    started = time.perf_counter()
    with StagedProgress(OF_TRAJECTORIES) as progress:
        found = find_recorded(recording, every=every, encoder=chosen, progress=progress.update)
    seconds = time.perf_counter() - started
    write(found, recording, seconds, out, json_file, plot)
    print_summary(found, recording, seconds)


def encoder_of(spec: str | None) -> PlaceEncoder | None:
    """The place encoder that an option or SEMDB_ENCODER names; None: the one that needs no file."""
    from semdb.api.tracing import encoder_named
    from semdb.cli.options import load_settings

    return encoder_named(load_settings(**({} if spec is None else {"encoder": spec})))


def check_outputs(out: Path | None, json_file: Path | None, plot: Path | None) -> None:
    """Raises UsageError where the results could not be written in the end, before anything is computed."""
    import os

    from semdb.errors import UsageError

    for option, file in (("--out", out), ("--json", json_file)):
        if file is None:
            continue
        target = file if file.exists() and not file.is_file() else file.parent
        if file.is_dir() or not target.exists() or not os.access(target, os.W_OK):
            raise UsageError(f"{option} {file}: cannot be written there; name a file in a folder that exists")
    if plot is not None:
        try:
            plot.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--plot {plot}: the folder cannot be made: {error.strerror}") from error


def write(
    found: RecordedTrajectory,
    recording: Recording,
    seconds: float,
    out: Path | None,
    json_file: Path | None,
    plot: Path | None,
) -> None:
    """Writes the files that were asked for."""
    import re

    from semdb.cli.output import print_json
    from semdb.cli.progress import say
    from semdb.trajectory.files import summary, trajectory_text

    if out is not None:
        with named(out):
            out.write_text(trajectory_text(found), encoding="utf-8")
    if json_file is not None:
        dropped = [{"name": one.name, "reason": one.reason} for one in recording.dropped]
        with named(json_file), json_file.open("w", encoding="utf-8") as stream:
            print_json({"recording": recording.name, "dropped": dropped, **summary(found, seconds)}, stream)
    if plot is not None:
        name = re.sub(r"[^\w.+-]+", "_", recording.name).strip("_.") or "recording"
        picture = plot / f"{name}-trajectory.png"
        with named(picture):
            picture.write_bytes(picture_of(found, recording))
        say(f"wrote {picture}")


@contextlib.contextmanager
def named(file: Path) -> Iterator[None]:
    """Says of which file it is that it cannot be written: a full disk does not."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(file)
        raise


def picture_of(found: RecordedTrajectory, recording: Recording) -> bytes:
    """The path from above as a PNG file."""
    import numpy as np

    from semdb.pictures.trajectory import draw_trajectory
    from semdb.recordings.images import encode_color

    used = found.trajectory.used
    true = [found.entries[frame.position].world_from_camera for frame in used]
    image = draw_trajectory(
        np.stack([frame.before_closing for frame in used if frame.before_closing is not None]),
        np.stack([frame.world_from_camera for frame in used if frame.world_from_camera is not None]),
        [n for n, frame in enumerate(used) if frame.keyframe >= 0],
        shown_closures(found),
        title=f"{recording.name}: the path from above",
        true=np.stack([pose for pose in true if pose is not None]) if all(p is not None for p in true) else None,
    )
    return encode_color(image)


def shown_closures(found: RecordedTrajectory) -> list[ShownClosure]:
    """Closures between frames of the largest piece, named by these; contradicted ones have no drift."""
    from semdb.pictures.trajectory import ShownClosure
    from semdb.trajectory.edges import EdgeState

    trajectory = found.trajectory
    place = {frame.position: n for n, frame in enumerate(trajectory.used)}
    drifts = {(drift.first, drift.second): (drift.metres, drift.degrees) for drift in trajectory.drifts}
    shown = []
    for edge in (*trajectory.closures(), *trajectory.closures(EdgeState.CONTRADICTED)):
        first, second = (trajectory.keyframes[number] for number in (edge.first, edge.second))
        if first in place and second in place:
            off = drifts.get((edge.first, edge.second), (0.0, 0.0))
            name = f"{found.entries[first].index}-{found.entries[second].index}"
            shown.append(ShownClosure(place[first], place[second], *off, edge.state is EdgeState.ACCEPTED, name))
    return shown


def print_summary(found: RecordedTrajectory, recording: Recording, seconds: float) -> None:
    """What people are told."""
    from semdb.cli.output import print_lines
    from semdb.trajectory.files import summary

    told = summary(found, seconds)
    closures, pieces = told["closures"], told["pieces"]
    without = told["frames"] - told["tracked"]
    lines = [
        ("recording", f"{recording.name} ({recording.format}) in {recording.path}"),
        ("frames", f"{told['frames']}, tracked {told['tracked']}, of these found again {told['relocalized']}"),
        *([("", f"{told['laid']} by surfaces, which keypoints did not carry")] if told["laid"] else []),
        ("without pose", f"{without}: lost {told['lost']}, left out {told['left_out']}" if without else "none"),
        *(("", f"frame {gone['frame']}: {gone['reason']}") for gone in told["without_pose"][:REASONS_SHOWN]),
        *([("", f"and {without - REASONS_SHOWN} more")] if without > REASONS_SHOWN else []),
        ("keyframes", f"{told['keyframes']}"),
        (
            "closures",
            f"{closures['accepted']} accepted, {closures['contradicted']} contradicted, {closures['failed']} failed",
        ),
        *(("", line) for line in refused(found)),
        ("path", f"{measure(told['length_m'], 2)} m"),
        ("world", world_of(found)),
        ("time", f"{measure(told['seconds_per_frame'], 3)} s per frame, {measure(seconds, 1)} s in all"),
    ]
    if not found.timed:
        lines.append(("note", "frames have no times that go on: 30 a second are assumed, and indexes stand for times"))
    if len(pieces) > 1:
        lines.append(("pieces", f"{len(pieces)} that nothing joins; the largest is used"))
        lines += [
            ("", f"{piece['frames']} frames, {piece['keyframes']} keyframes: {piece['first']} to {piece['last']}")
            for piece in pieces
        ]
    print_lines(*(f"{label:<13} {text}" for label, text in lines))


def world_of(found: RecordedTrajectory) -> str:
    """Which way the axes of the world point."""
    up = found.trajectory.up
    if up is None:
        return "axes of the first keyframe: which way is up cannot be told"
    return f"z up, as surfaces tell it, to {measure(up.sigma_deg, 1)} deg; origin and x of the first keyframe"


def refused(found: RecordedTrajectory) -> list[str]:
    """Closures that others contradict, one line each."""
    from semdb.trajectory.edges import EdgeState

    trajectory, lines = found.trajectory, []
    for edge in trajectory.closures(EdgeState.CONTRADICTED)[:REASONS_SHOWN]:
        first, second = (found.entries[trajectory.keyframes[n]].index for n in (edge.first, edge.second))
        lines.append(f"frames {first} and {second}: {edge.reason}")
    return lines
