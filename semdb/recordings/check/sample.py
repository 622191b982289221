"""The sample of a recording that is looked at: pairs of frames with some motion between them, spread over all of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from semdb.errors import FrameError
from semdb.geometry import invert_pose
from semdb.recordings.base import FrameEntry, Recording
from semdb.recordings.check.edges import EdgeFrame, depth_edges, edge_frame
from semdb.recordings.check.findings import Finding, Observed, find
from semdb.recordings.check.pairs import Pair, View, look, match
from semdb.recordings.check.readings import Reading
from semdb.types import FloatArray, Int64Array

PAIRS = 12  # that are looked for
LEAST_FLOW, MOST_FLOW = 25.0, 130.0  # pixels of an image of 640: enough to tell, little enough to match
START_NS = 330_000_000  # between the frames of the first try
FARTHEST_NS = 2_000_000_000
NEAR_S = 0.02
TRIES = 4
ARKIT_FORMATS = ("record3d", "polycam")  # whose poses are in these axes unless somebody says otherwise

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Report:
    """What was looked at, and what was found. `pairs` is how many pairs of frames told something."""

    findings: tuple[Finding, ...]
    pairs: int
    error_px: float  # median, of matches against poses and depth, in an image of 640 pixels; NaN without
    floor_px: float  # the same for the motion that the images say alone
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _Sample:
    """Views by position in the list of frames, made when they are first asked for."""

    recording: Recording
    entries: Sequence[FrameEntry]
    views: dict[int, View | None] = field(default_factory=dict)
    edges: dict[int, EdgeFrame] = field(default_factory=dict)
    depth_edges: dict[int, FloatArray | None] = field(default_factory=dict)
    times_ns: Int64Array | None = None

    def view(self, position: int) -> View | None:
        if position not in self.views:
            entry = self.entries[position]
            try:
                image, depth = self.recording.read_image(entry), self.recording.read_depth(entry)
            except FrameError:
                self.views[position] = None
            else:
                camera = self.recording.camera_of(entry)
                self.views[position] = look(position, image, depth, camera)
                if depth is not None:
                    self.edges[position] = edge_frame(image, depth)
        return self.views[position]

    def depth_edges_at(self, position: int, later_s: float) -> tuple[float, FloatArray] | None:
        """Edges of the depth image nearest to `later_s` after a frame, and how much later it is; None beyond 20 ms."""
        start = self.entries[position].timestamp_ns
        if start is None:
            return None
        if self.times_ns is None:
            self.times_ns = np.array([entry.timestamp_ns or 0 for entry in self.entries], dtype=np.int64)
        nearest = int(np.argmin(np.abs(self.times_ns - start - round(later_s * 1e9))))
        later = (int(self.times_ns[nearest]) - start) * 1e-9
        if abs(later - later_s) > NEAR_S:
            return None
        if nearest not in self.depth_edges:
            try:
                depth = self.recording.read_depth(self.entries[nearest])
            except FrameError:
                depth = None
            self.depth_edges[nearest] = None if depth is None else depth_edges(depth)
        found = self.depth_edges[nearest]
        return None if found is None else (later, found)


def check_recording(recording: Recording, *, progress: Progress | None = None) -> Report:
    """Looks at up to `PAIRS` pairs of frames; see `semdb.recordings.check.findings` for what is found."""
    entries = recording.entries
    sample = _Sample(recording, entries)
    pairs: list[Pair] = []
    steps: list[float] = []
    for done, start in enumerate(_starts(len(entries)), 1):
        found = _pair_from(sample, start)
        if found is not None:
            pairs.append(found)
            times = [entries[i].timestamp_ns for i in (found.first, found.second)]
            steps.append(float("nan") if None in times else (times[1] - times[0]) * 1e-9)  # type: ignore[operator]
        if progress is not None:
            progress(done, PAIRS)
    posed = [entry.world_from_camera for entry in entries]
    if recording.world_turn is not None:  # how poses are written shows before
        back = invert_pose(recording.world_turn)
        posed = [None if pose is None else back @ pose for pose in posed]
    reading = recording.reading
    axes = reading.axes or ("arkit" if recording.format in ARKIT_FORMATS else "opencv")
    observed = Observed(
        pairs=tuple(pairs),
        poses=None if any(pose is None for pose in posed) else np.stack([p for p in posed if p is not None]),
        times_ns=_times(entries),
        steps_s=np.array(steps),
        edges={pair.first: sample.edges[pair.first] for pair in pairs if pair.first in sample.edges},
        depth_edges_at=sample.depth_edges_at,
        current=Reading(reading.poses_are, axes, reading.quaternion or "xyzw"),
        takes=recording.takes,
        camera=recording.camera,
        depth_scale=recording.depth_scale,
        scale=reading.scale or 1.0,
        time_offset_ms=reading.time_offset_ms,
        depth_offset_ms=reading.depth_offset_ms,
    )
    findings, error, floor, notes = find(observed)
    return Report(tuple(findings), len(pairs), error, floor, tuple(notes))


def _starts(count: int) -> list[int]:
    """Positions to begin pairs at, spread evenly."""
    if count < 2:
        return []
    return sorted({round(i * (count - 2) / max(1, PAIRS - 1)) for i in range(PAIRS)})


def _pair_from(sample: _Sample, start: int) -> Pair | None:
    """A pair that begins at `start`, its end moved until there is neither too little nor too much motion."""
    end = _at(sample.entries, start, START_NS)
    best: Pair | None = None
    tried: set[int] = set()
    for _ in range(TRIES):
        if end in tried or not start < end < len(sample.entries):
            break
        tried.add(end)
        first, second = sample.view(start), sample.view(end)
        found = match(first, second) if first is not None and second is not None else None
        if found is None:
            end = start + max(1, (end - start) // 2)
            continue
        flow = float(np.median(np.hypot(*found.flow_px.T)))
        if best is None or flow > float(np.median(np.hypot(*best.flow_px.T))):
            best = found
        if flow >= LEAST_FLOW:
            break
        end = min(start + 2 * (end - start), _at(sample.entries, start, FARTHEST_NS))
    return best


def _at(entries: Sequence[FrameEntry], start: int, later_ns: int) -> int:
    """The position of the frame nearest to `later_ns` after `start`, at least the next one; by number without times."""
    first = entries[start].timestamp_ns
    if first is None:
        return min(len(entries) - 1, start + max(1, later_ns // START_NS))
    position = start + 1
    while position + 1 < len(entries) and (entries[position].timestamp_ns or 0) < first + later_ns:
        position += 1
    return position


def _times(entries: Sequence[FrameEntry]) -> Int64Array | None:
    times = [entry.timestamp_ns for entry in entries]
    if any(time is None for time in times):
        return None
    found = np.array(times, dtype=np.int64)
    return found if (np.diff(found) > 0).all() else None
