"""A trajectory from images and depth, start to end: tracking, closures, pose graph, bundle adjustment, all frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from semdb.errors import FrameError
from semdb.perception.protocols import Encoder, FeatureExtractor
from semdb.trajectory.closing import close_loops, edges_after_adjustment
from semdb.trajectory.closures import ClosureSearch
from semdb.trajectory.finish import finish
from semdb.trajectory.frames import EmptyFrame, ReadFrame, SeenFrame, see
from semdb.trajectory.odometry import FrameState, Odometry, track_of
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.result import Trajectory
from semdb.trajectory.solving import Solution, adjust_components
from semdb.types import Camera, FloatArray

AHEAD = 2  # frames that are read and described while one is placed

Progress = Callable[[str, int, int], None]


@dataclass(slots=True)
class _Clock:
    """Wall time of each stage."""

    spent: dict[str, float] = field(default_factory=dict)
    _since: float = field(default_factory=time.perf_counter)

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.spent[stage] = self.spent.get(stage, 0.0) + now - self._since
        self._since = now


def find_trajectory(
    read: ReadFrame,
    cameras: Sequence[Camera],
    times_s: FloatArray,
    features: FeatureExtractor,
    encoder: Encoder,
    options: TrajectoryOptions | None = None,
    progress: Progress | None = None,
) -> Trajectory:
    """The trajectory of frames with `cameras` ``[n]`` at ascending `times_s` ``[n]``.

    `read` gives image ``[H, W, 3]`` and registered depth ``[H, W]`` metres (or None) at a position, and may raise
    FrameError, which leaves the frame out. Images are read once, those of frames that tracking lost twice. The result
    is a function of the arguments: neither threads nor time change it.
    """
    options = options or TrajectoryOptions()
    clock = _Clock()
    odometry = Odometry(encoder, options)
    describe = _Describer(read, cameras, times_s, features, options)
    for position, frame in enumerate(_ahead(describe, len(cameras))):
        odometry.add(frame, float(times_s[position]))
        _tell(progress, "tracking", position + 1, len(cameras))
    clock.lap("tracking")
    search = ClosureSearch(odometry.keyframes, options)
    edges, solution = close_loops(odometry, search, options, lambda k, n: _tell(progress, "closing loops", k, n))
    clock.lap("closing")
    if options.adjust:
        far = search.near if options.close_loops else None
        solution, sharings = adjust_components(odometry.keyframes, solution, odometry.rates, options, far, progress)
        edges = edges_after_adjustment(edges, odometry, search, solution, sharings, options)
    clock.lap("adjustment")
    _look_again(odometry, describe, solution, progress)
    clock.lap("relocalization")
    return finish(odometry, edges, solution, options, clock.spent, progress)


class _Describer:
    def __init__(
        self,
        read: ReadFrame,
        cameras: Sequence[Camera],
        times_s: FloatArray,
        features: FeatureExtractor,
        options: TrajectoryOptions,
    ) -> None:
        self._read, self._cameras, self._times_s = read, cameras, times_s
        self._features, self._options = features, options

    def __call__(self, position: int) -> SeenFrame | EmptyFrame:
        try:
            image, depth = self._read(position)
        except FrameError as error:
            return EmptyFrame(position, str(error))
        camera, time_s = self._cameras[position], float(self._times_s[position])
        return see(position, time_s, image, depth, camera, self._features, self._options.frames)


def _ahead(describe: Callable[[int], SeenFrame | EmptyFrame], count: int) -> Iterator[SeenFrame | EmptyFrame]:
    """All frames in their order, the next ones described by a thread meanwhile."""
    with ThreadPoolExecutor(1, thread_name_prefix="semdb-frames") as pool:
        waiting = [pool.submit(describe, position) for position in range(min(AHEAD, count))]
        for position in range(count):
            found = waiting.pop(0).result()
            if position + AHEAD < count:
                waiting.append(pool.submit(describe, position + AHEAD))
            yield found


def _look_again(
    odometry: Odometry, describe: Callable[[int], SeenFrame | EmptyFrame], solution: Solution, progress: Progress | None
) -> None:
    """Frames that were lost are looked for among all keyframes, those of later included."""
    odometry.keyframes.move(solution.poses)
    lost = [row for row, track in enumerate(odometry.tracks) if track.state is FrameState.LOST]
    for done, row in enumerate(lost, start=1):
        frame = describe(odometry.tracks[row].position)
        if isinstance(frame, SeenFrame):
            placed, state = odometry.relocalize(frame), FrameState.RELOCALIZED
            if placed is None:
                placed, state = odometry.lay_beside(frame, row), FrameState.LAID
            if placed is not None:
                odometry.tracks[row] = track_of(frame, placed, state)
        _tell(progress, "looking for lost frames", done, len(lost))


def _tell(progress: Progress | None, what: str, done: int, total: int) -> None:
    if progress is not None:
        progress(what, done, total)
