"""What does not fit, and what would: one change of how a recording is read that explains the images far better.

Every change is judged alike: matches of neighbouring frames are moved by depth and poses, and the median of their
distances in pixels (of an image of 640) is compared with that as read. Right recordings have 0.4 to 12 pixels, what is
read wrongly 25 and more, so a factor of three between them is far from chance on either side.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from semdb.recordings.check.clocks import reversed_errors, shifted_errors
from semdb.recordings.check.edges import EdgeFrame
from semdb.recordings.check.motion import Change, errors, free_motion, translation_ratios
from semdb.recordings.check.pairs import Pair
from semdb.recordings.check.readings import AS_USUAL, Reading, readings, reread
from semdb.recordings.check.registration import DepthEdgesAt, Misplaced, misplaced
from semdb.recordings.options import option_of
from semdb.recordings.own_depth import resized
from semdb.shown import number
from semdb.types import Camera, FloatArray, Int64Array

LEAST_PAIRS = 3  # that tell anything at all
CERTAIN_PAIRS = 4
CERTAIN_FACTOR, LIKELY_FACTOR = 3.0, 2.0  # by which the error must fall
LEAST_ERROR_PX = 4.0  # as read; below it nothing is wrong
HOPELESS_PX = 25.0  # what no right recording has
GOOD_PX, GOOD_FLOORS = 9.0, 4.0  # what a right reading reaches: so many pixels, or times the error of free motion
IMPROVED = 0.7  # a pair is better when its error falls below this share
SIMPLER = 1.4  # of two explanations the simpler one unless the other is better by this factor
DEPTH_FACTORS = np.geomspace(0.02, 50, 57)
FOCAL_FACTORS = np.geomspace(0.4, 2.5, 37)
USUAL_SCALES = (1.0, 100.0, 256.0, 500.0, 1000.0, 2000.0, 4000.0, 5000.0, 6553.5, 8000.0, 10000.0)
LEAST_FACTOR = 1.12  # of depth or focal length; a smaller one is calibration, no convention
ROOM_M = (0.15, 15.0)  # within which the median depth of a room lies
LEAST_OFFSET_S = 0.02
FULL = (640, 480)  # of the image whose pixels a displacement of depth is given in
LEAST_RATIO, CERTAIN_RATIO = 1.6, 2.0  # of translations by images and by poses
SPREADS, WIDEST_SPREAD = 3.0, 0.45  # of their logarithms


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that the images contradict.

    `kind` is ``poses_are``, ``axes``, ``quaternion``, ``depth_scale``, ``scale``, ``focal``, ``times``,
    ``time_offset``, ``depth_time_offset``, ``depth_registration`` or ``poses``. `value` is what fits, `option` what
    mends it ("" where nothing does). What is not `certain` is likely.
    """

    kind: str
    certain: bool
    value: float | str
    option: str
    message: str


@dataclass(frozen=True, slots=True, eq=False)
class Observed:
    """What a sample of a recording shows, as arrays; poses ``[n, 4, 4]`` and times are of all frames."""

    pairs: tuple[Pair, ...]
    poses: FloatArray | None = None
    times_ns: Int64Array | None = None
    steps_s: FloatArray = field(default_factory=lambda: np.empty(0))  # between the frames of each pair
    edges: Mapping[int, EdgeFrame] = field(default_factory=dict)  # by frame
    depth_edges_at: DepthEdgesAt | None = None
    current: Reading = AS_USUAL
    takes: frozenset[str] = frozenset()
    camera: Camera | None = None
    depth_scale: float = 1000.0
    scale: float = 1.0  # metres per unit of poses
    time_offset_ms: float = 0.0
    depth_offset_ms: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """A way to read the recording: what it changes, and the error of each pair."""

    changes: Mapping[str, float | str]
    errors: FloatArray

    @property
    def error(self) -> float:
        return float(np.nanmedian(self.errors)) if np.isfinite(self.errors).any() else np.inf


def find(observed: Observed) -> tuple[list[Finding], float, float, list[str]]:
    """The findings, the error as read and that of free motion in pixels, and notes on what could not be checked."""
    notes: list[str] = []
    depths = [np.concatenate([pair.depth_first, pair.depth_second]) for pair in observed.pairs]
    with_depth = sum(bool(np.isfinite(depth).mean() > 0.2) for depth in depths)
    if len(observed.pairs) < LEAST_PAIRS:
        notes.append(f"only {len(observed.pairs)} pairs of frames have enough in common: nothing was checked")
        return [], float("nan"), float("nan"), notes
    found: list[Finding] = []
    error, floor = float("nan"), float("nan")
    if with_depth < LEAST_PAIRS:
        notes.append("too few frames have depth: poses and scales were not checked")
        return found, error, floor, notes
    free = [motion for motion in map(free_motion, observed.pairs) if motion is not None]
    floor = float(np.median([residual for _, residual in free])) if free else float("nan")
    if observed.poses is None:
        notes.append("no poses: only whether depth lies where colour does was checked")
    else:
        as_read = _Explanation({}, errors(observed.pairs, observed.poses))
        error, depth = as_read.error, float(np.nanmedian(np.concatenate(depths)))
        if error >= LEAST_ERROR_PX:
            found += _judge(observed, as_read, _best(observed, as_read), floor, depth)
        if not found:
            found += _turning(observed, floor, depth)
        if not found and len(observed.pairs) >= CERTAIN_PAIRS and error >= HOPELESS_PX and floor <= GOOD_PX:
            text = f"matches of neighbouring frames are {error:.0f} px off, and no other reading explains them"
            found.append(Finding("poses", False, round(error, 1), "", f"poses do not fit the images: {text}"))
    if all(finding.kind == "time_offset" for finding in found):  # what is of depth alone does not depend on poses
        found += _depth_findings(observed)
    return found, error, floor, notes


def _best(observed: Observed, as_read: _Explanation) -> _Explanation:
    """The simplest explanation that is about as good as the best one."""
    alternatives = list(_alternatives(observed))
    least = min(explanation.error for explanation in alternatives)
    simple = sorted(alternatives, key=lambda explanation: (len(explanation.changes), explanation.error))
    return next(e for e in simple if e.error <= SIMPLER * max(least, 0.5))


def _alternatives(observed: Observed) -> Iterator[_Explanation]:
    """Everything that is tried, each with what it changes. The poses as read are not among them."""
    assert observed.poses is not None
    pairs, poses = observed.pairs, observed.poses
    yield _depth_factor(observed, poses, {})
    yield _focal_factor(observed, poses)
    if observed.times_ns is not None and "time_offset_ms" in observed.takes:
        yield from _time_offset(observed)
    for reading in readings(observed.current, quaternions="quaternion" in observed.takes):
        changes = observed.current.differences(reading)
        if observed.current.axes == "arkit" and changes.get("axes") == "opengl":
            del changes["axes"]
        if not changes or not set(changes) <= observed.takes:
            continue
        other = reread(poses, observed.current, reading)
        yield _Explanation(changes, errors(pairs, other))
        yield _depth_factor(observed, other, changes)


def _depth_factor(observed: Observed, poses: FloatArray, changes: Mapping[str, float | str]) -> _Explanation:
    def tried(factor: float) -> FloatArray:
        return errors(observed.pairs, poses, Change(depth=factor))

    factor, best = _search(tried, DEPTH_FACTORS)
    return _Explanation({**changes, "depth_factor": factor}, best)


def _focal_factor(observed: Observed, poses: FloatArray) -> _Explanation:
    factor, best = _search(lambda value: errors(observed.pairs, poses, Change(focal=value)), FOCAL_FACTORS)
    return _Explanation({"focal_factor": factor}, best)


def _search(tried, factors: FloatArray) -> tuple[float, FloatArray]:  # type: ignore[no-untyped-def]
    """The factor with the least median error: of `factors`, then twice finer around the best."""
    step = float(factors[1] / factors[0])
    results = {float(value): tried(float(value)) for value in factors}
    for _ in range(3):
        best = min(results, key=lambda value: float(np.nanmedian(results[value])))
        step = step**0.5
        for value in (best / step, best * step):
            results.setdefault(value, tried(value))
    best = min(results, key=lambda value: float(np.nanmedian(results[value])))
    return best, results[best]


def _time_offset(observed: Observed) -> Iterator[_Explanation]:
    assert observed.times_ns is not None
    assert observed.poses is not None
    found = shifted_errors(observed.pairs, observed.poses, observed.times_ns)
    if found is not None and abs(found[0]) >= LEAST_OFFSET_S:
        yield _Explanation({"time_offset_s": found[0]}, found[1])
    if "times" in observed.takes:
        yield _Explanation({"times": "reversed"}, reversed_errors(observed.pairs, observed.poses, observed.times_ns))


def _turning(observed: Observed, floor: float, median_depth: float) -> list[Finding]:
    """The factor of depth where the camera turns more than it moves: by how long it moves, not by where points are."""
    assert observed.poses is not None
    ratios = translation_ratios(observed.pairs, observed.poses)
    logs = np.log(ratios[np.isfinite(ratios) & (ratios > 0)])
    if len(logs) < max(CERTAIN_PAIRS, len(ratios) / 2):
        return []
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    if abs(middle) < np.log(LEAST_RATIO) or abs(middle) < SPREADS * max(spread, 0.02):
        return []
    certain = abs(middle) >= np.log(CERTAIN_RATIO) and spread <= WIDEST_SPREAD and floor <= GOOD_PX
    factor = float(np.exp(-middle))
    text = f"the images say that the camera moved {np.exp(middle):.2g} times as far as the poses do"
    return [_scale_finding(observed, factor, certain, text, median_depth)]


def _judge(
    observed: Observed, as_read: _Explanation, best: _Explanation, floor: float, median_depth: float
) -> list[Finding]:
    """Findings where the best explanation is far better than the recording as read."""
    both = np.isfinite(as_read.errors) & np.isfinite(best.errors)
    if both.sum() < LEAST_PAIRS:
        return []
    before, after = (float(np.median(e[both])) for e in (as_read.errors, best.errors))
    share = float((best.errors[both] < IMPROVED * as_read.errors[both]).mean())
    if before < LEAST_ERROR_PX or share < IMPROVED or after > before / LIKELY_FACTOR:
        return []
    if any(
        1 / LEAST_FACTOR < float(best.changes.get(name, np.inf)) < LEAST_FACTOR
        for name in ("depth_factor", "focal_factor")
    ):
        return []
    good = max(GOOD_PX, GOOD_FLOORS * floor)
    certain = after <= good and before >= CERTAIN_FACTOR * after and both.sum() >= CERTAIN_PAIRS and share >= 0.8
    if not certain and after > 2 * good:
        return []  # bad before and after: the poses are bad in a way that no reading mends
    text = f"matches of neighbouring frames are {before:.0f} px off as read, {after:.1f} px then"
    return [
        finding
        for name, value in best.changes.items()
        for finding in _finding(observed, name, value, certain, text, median_depth)
    ]


def _finding(
    observed: Observed, name: str, value: float | str, certain: bool, text: str, median_depth: float
) -> Iterator[Finding]:
    if name in ("poses_are", "axes", "quaternion"):
        what = {"poses_are": "the poses are", "axes": "the poses are of axes", "quaternion": "quaternions are"}[name]
        yield Finding(name, certain, value, f"{option_of(name)} {value}", f"{what} {value}: {text}")
    elif name == "times":
        yield Finding("times", certain, value, f"--times {value}", f"the poses run backwards through the times: {text}")
    elif name == "depth_factor":
        yield _scale_finding(observed, float(value), certain, text, median_depth)
    elif name == "focal_factor":
        option = ""
        if observed.camera is not None:
            option = _camera_option(observed.camera, float(value))
        yield Finding(
            "focal", certain, round(float(value), 3), option, f"the focal length is {value:.3g} times as long: {text}"
        )
    elif name == "time_offset_s":
        offset = round(observed.time_offset_ms - float(value) * 1000)
        text = f"poses are of {abs(float(value)) * 1000:.0f} ms {'earlier' if float(value) > 0 else 'later'}: {text}"
        yield Finding("time_offset", certain, offset, f"--time-offset-ms {offset}", text)


def _scale_finding(observed: Observed, factor: float, certain: bool, text: str, median_depth: float) -> Finding:
    """Depth in other units, or poses where depth would be of no room then."""
    inside = ROOM_M[0] <= median_depth * factor <= ROOM_M[1]
    if not inside and ROOM_M[0] <= median_depth <= ROOM_M[1]:
        value = _snapped(observed.scale / factor, (1.0, 0.01, 0.001, 0.0254, 0.3048))
        option = f"--scale {number(value)}" if "scale" in observed.takes else ""
        return Finding("scale", certain, value, option, f"a unit of the poses is {number(value)} m: {text}")
    value = _snapped(observed.depth_scale / factor, USUAL_SCALES)
    option = f"--depth-scale {number(value)}" if "depth_scale" in observed.takes else ""
    return Finding(
        "depth_scale",
        certain,
        value,
        option,
        f"depth has {number(value)} units a metre, not {number(observed.depth_scale)}: {text}",
    )


def _snapped(value: float, usual: Sequence[float]) -> float:
    """A usual number where one is within 8 %, else `value` with three digits."""
    nearest = min(usual, key=lambda known: abs(np.log(known / value)))
    return nearest if abs(np.log(nearest / value)) < 0.08 else float(f"{value:.3g}")


def _camera_option(camera: Camera, factor: float) -> str:
    """The intrinsics with another focal length: those of the image in another size where that centres them better."""
    fx, fy, cx, cy = camera.fx * factor, camera.fy * factor, camera.cx, camera.cy
    moved = resized(camera, max(1, round(camera.width * factor)), max(1, round(camera.height * factor)))
    middle = (camera.width - 1) / 2
    if abs(moved.cx - middle) < abs(cx - middle):
        cx, cy = moved.cx, moved.cy
    return f"--camera {fx:.5g},{fy:.5g},{cx:.5g},{cy:.5g}"


def _depth_findings(observed: Observed) -> Iterator[Finding]:
    """Depth that does not lie where colour does, or is of another time."""
    place: Misplaced | None = misplaced(observed.pairs, observed.edges, observed.steps_s, observed.depth_edges_at)
    if place is None:
        return
    if place.delay_s:
        offset = round(observed.depth_offset_ms + place.delay_s * 1000)
        text = (
            f"depth is of {abs(place.delay_s) * 1000:.0f} ms {'later' if place.delay_s > 0 else 'earlier'} than colour"
        )
        option = f"--depth-offset-ms {offset}" if "depth_offset_ms" in observed.takes else ""
        yield Finding("depth_time_offset", False, offset, option, f"{text}: its edges lie behind those of what moves")
        return
    x, y = place.shift
    option = ""
    if "depth_camera" in observed.takes and observed.camera is not None:
        option = f"--depth-camera {_depth_camera(observed.camera, place)}"
    text = (
        f"depth is not registered to colour: its edges fit when {place.zoom:.2f} times as large and moved by {x:.0f}, "
        f"{y:.0f} px of 640: register it first, or say where it is from"
    )
    yield Finding("depth_registration", False, place.zoom, option, text)


def _depth_camera(camera: Camera, place: Misplaced) -> str:
    """Intrinsics of the camera that sees depth where it is: its image, stretched and moved, is colour's."""
    numbers = []
    for size, full, focal, middle, shift in (
        (camera.width, FULL[0], camera.fx, camera.cx, place.shift[0]),
        (camera.height, FULL[1], camera.fy, camera.cy, place.shift[1]),
    ):
        own = (middle - (1 - place.zoom) * (size - 1) / 2 - shift * size / full) / place.zoom
        numbers.append((focal / place.zoom, own))
    (fx, cx), (fy, cy) = numbers
    return f"{fx:.5g},{fy:.5g},{cx:.5g},{cy:.5g}"
