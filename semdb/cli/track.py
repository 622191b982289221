"""`semdb track`: a camera that moves through a map, frame after frame."""

from __future__ import annotations

import json as jsonlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import (
    CameraOption,
    Overrides,
    Reading,
    open_database,
    reading_options,
    settings_options,
)
from semdb.cli.server import ServerOption, check_server, open_server
from semdb.shown import measure

if TYPE_CHECKING:
    from semdb.api import Database
    from semdb.client import RemoteDatabase
    from semdb.door.tracked import Tracked
    from semdb.errors import FrameError
    from semdb.recordings import ReadOptions

VIDEO_ENDINGS = frozenset([".mp4", ".avi", ".mkv", ".mov", ".webm", ".m4v"])
USUAL_RATE_HZ = 30.0


@settings_options(models=True)
@reading_options()
def command(
    source: Annotated[
        Path, typer.Argument(metavar="RECORDING|FOLDER|VIDEO", help="Frames in the order in which they were taken.")
    ],
    overrides: Overrides,
    reading: Reading,
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="M", help="Map to track in; may be left out where there is one.")
    ] = None,
    odometry: Annotated[
        Path | None,
        typer.Option("--odometry", metavar="FILE", help="Odometry of the camera in TUM's format, times of the frames."),
    ] = None,
    query_depth: Annotated[
        bool, typer.Option("--query-depth", help="Use the depth of a recording too, not the colour alone.")
    ] = False,
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Weigh each pose against the 60 frames after it too.")
    ] = False,
    like: Annotated[
        str | None,
        typer.Option("--like", metavar="RECORDING", help="Recording (name or folder) whose camera took the images."),
    ] = None,
    camera: CameraOption = None,
    every: Annotated[int, typer.Option("--every", metavar="N", min=1, help="Every N-th frame.")] = 1,
    rate: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", min=0.001, help="Frames a second of a folder of images; default 30."),
    ] = None,
    server: ServerOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Write poses of tracked frames in TUM's format.")
    ] = None,
    json_lines: Annotated[
        bool, typer.Option("--json-lines", help="Print a JSON object a line and frame, as they come, on stdout.")
    ] = False,
) -> None:
    """Track a camera through a map, with a state for each frame: tracking, coasting, initialising or lost.

    Networks run only where the camera has to be looked for in the whole map. A frame that cannot be read is named on
    stderr and makes the exit code 1; the others are tracked all the same.
    """
    from semdb.cli.output import print_lines

    if server is not None:
        check_server(server, overrides, {"--smooth": smooth})
    unread: list[str] = []
    asked = Asked(map_name, like, camera, reading, every, query_depth, smooth, rate, unread)
    tally = Tally()
    opened = open_server(server) if server is not None else open_database(overrides.settings())
    with opened as database, Output(out, json_lines) as output:
        for answer in asked.answers(database, source, odometry):
            tally.add(answer)
            output.add(answer)
    if not json_lines:
        print_lines(tally.line)
    if unread:
        raise typer.Exit(1)


class Asked:
    """How frames are asked."""

    def __init__(
        self,
        map_name: str | None,
        like: str | None,
        camera: str | None,
        reading: ReadOptions,
        every: int,
        query_depth: bool,
        smooth: bool,
        rate: float | None,
        unread: list[str],
    ) -> None:
        self.map, self.like, self.camera, self.reading = map_name, like, camera, reading
        self.every, self.query_depth, self.smooth, self.rate, self.unread = every, query_depth, smooth, rate, unread

    def answers(self, database: Database | RemoteDatabase, source: Path, odometry: Path | None) -> Iterator[Tracked]:
        """One by one. Raises UsageError for options that mean nothing to the source."""
        from semdb.api.tracking import odometry_file
        from semdb.errors import UsageError
        from semdb.recordings.layouts import find_layout, not_a_recording

        if source.exists() and find_layout(source) is not None:
            if self.rate is not None:
                raise UsageError("--rate is for folders of images; a recording has times")
            options: dict[str, Any] = {"smooth": True} if self.smooth else {}
            yield from database.track_recording(
                source,
                map=self.map,
                camera=self.camera,
                reading=self.reading,
                like=self.like,
                every=self.every,
                query_depth=self.query_depth,
                odometry=None if odometry is None else odometry_file(odometry),
                unreadable=self._unreadable,
                **options,
            )
            return
        for option, given in (("--odometry", odometry is not None), ("--query-depth", self.query_depth)):
            if given:
                raise UsageError(f"{option} is for recordings, and {source} is none")
        if source.is_dir():
            frames = images_of(source, self.every, self.rate or USUAL_RATE_HZ)
        elif source.suffix.lower() in VIDEO_ENDINGS:
            frames = video_frames(source, self.every, self.rate)
        else:
            raise not_a_recording(source)
        yield from self._each(database, frames)

    def _each(
        self, database: Database | RemoteDatabase, frames: Iterator[tuple[object, float, str]]
    ) -> Iterator[Tracked]:
        from semdb.api.tracking import MapTracker, smooth_answers
        from semdb.errors import FrameError

        tracker = database.tracker(self.map, camera=self.camera, like=self.like, depth_scale=self.reading.depth_scale)

        def answers() -> Iterator[Tracked]:
            for image, time_s, name in frames:
                try:
                    yield tracker.update(image, time_s=time_s, name=name)  # type: ignore[arg-type]
                except FrameError as error:
                    self._unreadable(error)

        yield from smooth_answers(answers(), tracker) if isinstance(tracker, MapTracker) and self.smooth else answers()

    def _unreadable(self, error: FrameError) -> None:
        from semdb.cli.progress import say

        self.unread.append(str(error))
        say(str(error))


def images_of(folder: Path, every: int, rate_hz: float) -> Iterator[tuple[object, float, str]]:
    """The images of a folder by name, with times of so many a second. Raises RecordingError where there are none."""
    from semdb.cli.localize import IMAGE_ENDINGS
    from semdb.recordings.layouts import not_a_recording

    images = sorted(child for child in folder.iterdir() if child.suffix.lower() in IMAGE_ENDINGS)
    if not images:
        raise not_a_recording(folder)
    for number in range(0, len(images), every):
        yield images[number], number / rate_hz, images[number].name


def video_frames(path: Path, every: int, rate_hz: float | None) -> Iterator[tuple[object, float, str]]:
    """The frames of a video as RGB arrays, with its times. Raises RecordingError for one that cannot be decoded."""
    import cv2

    from semdb.errors import RecordingError

    video = cv2.VideoCapture(str(path))
    try:
        rate = rate_hz or video.get(cv2.CAP_PROP_FPS) or USUAL_RATE_HZ
        number = -1
        while True:
            there, image = video.read()
            if not there:
                break
            number += 1
            if number % every == 0:
                yield cv2.cvtColor(image, cv2.COLOR_BGR2RGB), number / rate, f"{path.name} frame {number}"
    finally:
        video.release()
    if number < 0:
        raise RecordingError(f"{path}: no frame of the video can be decoded; convert it to H.264 in an MP4 file")


class Tally:
    """Counts states and latencies for the last line."""

    def __init__(self) -> None:
        self._states: dict[str, int] = {}
        self._latencies: list[float] = []

    def add(self, answer: Tracked) -> None:
        self._states[str(answer.state)] = self._states.get(str(answer.state), 0) + 1
        self._latencies.append(answer.latency_ms)

    @property
    def line(self) -> str:
        """``tracked 206 of 208 frames (1 coasting, 1 lost), half of them within 32 ms``."""
        import statistics

        total = len(self._latencies)
        others = ", ".join(f"{n} {state}" for state, n in self._states.items() if state != "tracking")
        spent = f", half of them within {statistics.median(self._latencies):.0f} ms" if total else ""
        return f"tracked {self._states.get('tracking', 0)} of {total} frames{f' ({others})' * bool(others)}{spent}"


class Output:
    """Prints answers, and writes their poses. A context manager."""

    HEAD = (
        f"  {'frame':>6}  {'state':12} {'source':11} {'x':>8} {'y':>8} {'z':>8} m  "
        f"{'sigma':>18}  {'inliers':>7} {'ms':>6}"
    )

    def __init__(self, out: Path | None, json_lines: bool) -> None:
        from semdb.cli.localized import trajectory_file

        self._json, self._begun, self._number = json_lines, False, 0
        self._file = trajectory_file(out)

    def __enter__(self) -> Output:
        self._poses = self._file.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        self._file.__exit__(*error)  # type: ignore[arg-type]

    def add(self, answer: Tracked) -> None:
        """The answer for the next frame."""
        from semdb.cli.output import SIGMA_NOTE, print_lines

        if self._poses is not None and answer.tracking and answer.world_from_camera is not None:
            time_ns = round(answer.time_s * 1e9) if answer.timestamp_ns is None else answer.timestamp_ns
            self._poses.write(time_ns, answer.world_from_camera)
        if self._json:
            print_lines(jsonlib.dumps(answer.as_dict(), allow_nan=False))
            return
        if not self._begun:
            self._begun = True
            print_lines(f"in map {answer.map}; sigma is {SIGMA_NOTE}", self.HEAD)
        print_lines(self._line(answer))
        self._number += 1

    def _line(self, answer: Tracked) -> str:
        label = self._number if answer.frame_index is None else answer.frame_index
        start = f"  {label:>6}  {answer.state:12} {answer.source:11} "
        if answer.position is None:
            return start + answer.reason
        x, y, z = answer.position
        sigma = f"{measure(1000 * answer.sigma_m, 1)} mm {measure(answer.sigma_deg, 2)} deg"
        return start + f"{x:8.3f} {y:8.3f} {z:8.3f} m  {sigma:>18}  {answer.inliers:>7} {answer.latency_ms:6.0f}"
