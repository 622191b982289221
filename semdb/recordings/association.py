"""TUM's text lists, association by nearest time, and poses interpolated between samples."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
import numpy.typing as npt

from semdb.errors import RecordingError
from semdb.files import fields_of, parse_number, without_comment
from semdb.geometry import (
    FARTHEST_POSE_M,
    pose_from,
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    rotations_from_quats_wxyz,
    slerp_wxyz,
    so3_log,
)
from semdb.recordings.lines import TOO_FAR, BadLine, read_lines
from semdb.recordings.options import ReadOptions
from semdb.recordings.poses import numbers_of, pose_of_numbers
from semdb.types import FloatArray

MAX_TIME_DIFFERENCE_NS = 20_000_000
TURN_WINDOW_NS = 50_000_000
ASSOCIATIONS = "associations.txt"
LONGEST_TIME = 100  # characters
NORM_TOLERANCE = 0.05  # data sets round quaternions to four digits; more than this is no rotation

_TIME_AND_NAME = re.compile(r"([^\s,;]+(?:,\d+)?)(?:\s*[,;]\s*|\s+)(\S.*)")
_PLAIN_POSE = re.compile(r"[^\s,;#%/]{1,100}(?:\s+[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?){7}", re.ASCII)
_UNUSUAL = re.compile(r"""["'\\#%]|\s//""")

Int64Array = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TimedFile:
    """One line of ``rgb.txt`` or ``depth.txt``."""

    time_ns: int
    name: str
    line: int


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Pose samples in ascending time."""

    time_ns: Int64Array  # [n]
    quat_wxyz: FloatArray  # [n, 4], unit
    translation: FloatArray  # [n, 3] metres


def parse_time_ns(text: str) -> int:
    """Nanoseconds of a decimal number of seconds, exactly. Raises ValueError with the reason."""
    try:
        seconds = Decimal(text if len(text) <= LONGEST_TIME and "_" not in text else "")
    except InvalidOperation as error:
        raise ValueError(f"{text[:40]!r} is no time in seconds") from error
    if not seconds.is_finite() or abs(seconds) > Decimal("9.2e9"):
        raise ValueError(f"{text[:40]!r} is no time in seconds")
    return int((seconds * 1_000_000_000).to_integral_value())


def read_file_list(path: Path) -> tuple[list[TimedFile], list[BadLine]]:
    """Lines of ``time filename`` in the order of the file, and those that cannot be used. Raises RecordingError."""
    files, bad = [], []
    for number, line in read_lines(path):
        found = _TIME_AND_NAME.fullmatch(line)
        try:
            if found is None:
                raise ValueError("needs a time and a file name")
            time = found[1].replace(",", ".") if "." not in found[1] else found[1]
            files.append(TimedFile(parse_time_ns(time), existing_name(path.parent, found[2]), number))
        except ValueError as error:
            bad.append(BadLine(number, str(error)))
    if not files:
        where = f", line {bad[0].line}: {bad[0].reason}" if bad else ": lists no image"
        raise RecordingError(f"{path}{where}; lines of 'time filename' are needed")
    return files, bad


def has_times(path: Path) -> bool:
    """Whether an ``associations.txt`` has times, as TUM's associate.py writes them, not ICL-NUIM's frame numbers."""
    try:
        lines = read_lines(path)
    except RecordingError:
        return False
    return any("." in line.split()[0] for _, line in lines[:10])


def read_associations(path: Path) -> tuple[list[TimedFile], list[TimedFile], list[BadLine]]:
    """Colour and depth images of lines ``time rgb/NAME time depth/NAME`` (or depth first), and unusable lines.

    Raises RecordingError.
    """
    colour, depth, bad = [], [], []
    for number, line in read_lines(path):
        parts = without_comment(line).split()
        try:
            if len(parts) != 4:
                raise ValueError("needs 'time rgb/NAME time depth/NAME'")
            pair = [
                TimedFile(parse_time_ns(parts[k]), existing_name(path.parent, parts[k + 1]), number) for k in (0, 2)
            ]
        except ValueError as error:
            bad.append(BadLine(number, str(error)))
            continue
        if "depth" in pair[0].name and "depth" not in pair[1].name:
            pair.reverse()
        colour.append(pair[0])
        depth.append(pair[1])
    if not colour:
        where = f", line {bad[0].line}: {bad[0].reason}" if bad else ": lists no image"
        raise RecordingError(f"{path}{where}")
    return colour, depth, bad


def existing_name(folder: Path, text: str) -> str:
    """The name of a file as a line of a list gives it: without quotes around it, without a comment after it, and with
    slashes for the backslashes of Windows, unless a file has the very name.
    """
    if not _UNUSUAL.search(text) or _is_there(folder, text):
        return text
    name = without_comment(text).strip("\"'")
    return name if _is_there(folder, name) else name.replace("\\", "/")


def _is_there(folder: Path, name: str) -> bool:
    try:
        return (folder / name).exists()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def parse_pose(values: Sequence[str], quaternion: str | None = None) -> tuple[FloatArray, FloatArray]:
    """Unit quaternion wxyz and translation of seven texts ``tx ty tz qx qy qz qw``. Raises ValueError.

    `quaternion` "wxyz" says that the last four are qw qx qy qz instead.
    """
    if len(values) != 7:
        raise ValueError(f"needs tx ty tz qx qy qz qw, but has {len(values)} numbers")
    numbers = np.array([parse_number(value) for value in values])
    quat_wxyz = numbers[3:] if quaternion == "wxyz" else numbers[[6, 3, 4, 5]]
    with np.errstate(over="ignore"):
        norm = float(np.linalg.norm(quat_wxyz))
    if not abs(norm - 1) <= NORM_TOLERANCE:
        raise ValueError(f"is no rotation: the quaternion has length {norm:.3g} instead of 1")
    if np.abs(numbers[:3]).max() > FARTHEST_POSE_M:
        raise ValueError(TOO_FAR)
    return quat_wxyz / norm, numbers[:3]


def read_trajectory(
    path: Path, options: ReadOptions | None = None, times_ns: Sequence[int] = ()
) -> tuple[Trajectory, list[str]]:
    """Poses of a TUM trajectory (``time tx ty tz qx qy qz qw``) sorted by time, and notes on what was not right.

    A line may have the 16 (or 12) numbers of a matrix instead, after the time or alone: then lines belong to `times_ns`
    in turn. Lines that cannot be used are left out and noted; of equal times the first is kept. `options`
    say what the poses are of; what is returned are ``world_from_camera`` at the times of colour.
    Raises RecordingError when no line can be used.
    """
    options = options or ReadOptions()
    lines = read_lines(path)
    plain = _read_plain(lines, options.quaternion)
    if plain is not None:
        return _in_order(path, *plain, [], options)
    samples: list[tuple[int, FloatArray, FloatArray]] = []
    bad: list[BadLine] = []
    commas = False
    for place, (number, line) in enumerate(lines):
        values, has_commas = fields_of(line)
        commas |= has_commas
        try:
            if len(values) in (12, 16) and place >= len(times_ns):
                raise ValueError(f"is a matrix without a time, and there are only {len(times_ns)} colour images")
            time_ns = times_ns[place] if len(values) in (12, 16) else parse_time_ns(values[0])
            samples.append((time_ns, *_parse_sample(values, options.quaternion)))
        except ValueError as error:
            bad.append(BadLine(number, str(error)))
    if not samples:
        where = f", line {bad[0].line}: {bad[0].reason}" if bad else ": has no pose"
        raise RecordingError(f"{path}{where}; lines of 'time tx ty tz qx qy qz qw' are needed")
    notes = [bad_lines_note(path.name, bad, "poses")] if bad else []
    if commas:
        notes.append(decimal_commas_note(path.name))
    quats, translations = (np.stack([sample[k] for sample in samples]) for k in (1, 2))
    return _in_order(path, [sample[0] for sample in samples], quats, translations, notes, options)


def _read_plain(
    lines: Sequence[tuple[int, str]], quaternion: str | None
) -> tuple[list[int], FloatArray, FloatArray] | None:
    """Times, unit quaternions wxyz ``[n, 4]`` and translations ``[n, 3]`` of a file in which every line is as usual.

    None for any other: then it is read line by line, which takes ten times as long.
    """
    if not lines or not all(_PLAIN_POSE.fullmatch(line) for _, line in lines):
        return None
    texts = [line.split() for _, line in lines]
    try:
        times = [parse_time_ns(parts[0]) for parts in texts]
    except ValueError:
        return None
    numbers = np.array([parts[1:] for parts in texts], dtype=np.float64)
    if not (np.abs(numbers[:, :3]) <= FARTHEST_POSE_M).all():
        return None
    quats = numbers[:, 3:] if quaternion == "wxyz" else numbers[:, [6, 3, 4, 5]]
    with np.errstate(over="ignore"):
        norms = np.array([np.linalg.norm(quat) for quat in quats])[:, None]  # the same bits as line by line
    if not (np.isfinite(numbers).all() and (np.abs(norms - 1) <= NORM_TOLERANCE).all()):
        return None
    return times, quats / norms, numbers[:, :3]


def _in_order(
    path: Path,
    time_ns: Sequence[int],
    quats_wxyz: FloatArray,
    translations: FloatArray,
    notes: list[str],
    options: ReadOptions,
) -> tuple[Trajectory, list[str]]:
    """The trajectory of samples in the order of their times; of equal ones the first."""
    times = np.array(time_ns, dtype=np.int64)
    if (np.diff(times) < 0).any():
        notes.append(f"{path.name}: times are not in ascending order; sorted")
    order = np.argsort(times, kind="stable")
    first = np.concatenate([[True], np.diff(times[order]) > 0])
    if not first.all():
        notes.append(f"{path.name}: {int((~first).sum())} repeated time(s); the first pose of each is kept")
    keep = order[first]
    return corrected(Trajectory(times[keep], quats_wxyz[keep], translations[keep]), options), notes


def _parse_sample(values: Sequence[str], quaternion: str | None) -> tuple[FloatArray, FloatArray]:
    """Quaternion wxyz and translation of a line's values, a matrix or a quaternion, its time among them or not."""
    if len(values) not in (12, 13, 16, 17):
        return parse_pose(values[1:], quaternion)
    pose = pose_of_numbers(numbers_of(" ".join(values[len(values) % 2 :])))
    return quat_wxyz_from_rotation(pose[:3, :3]), pose[:3, 3]


def corrected(trajectory: Trajectory, options: ReadOptions) -> Trajectory:
    """The trajectory as `options` say it is to be understood: its times, its direction, its axes."""
    times = trajectory.time_ns + round(options.time_offset_ms * 1e6)
    if not options.changes_poses:
        return Trajectory(times, trajectory.quat_wxyz, trajectory.translation)
    rotations = rotations_from_quats_wxyz(trajectory.quat_wxyz)
    poses = [options.pose(pose_from(*sample)) for sample in zip(rotations, trajectory.translation, strict=True)]
    quats = np.stack([quat_wxyz_from_rotation(pose[:3, :3]) for pose in poses])
    return Trajectory(times, quats, np.stack([pose[:3, 3] for pose in poses]))


def backwards(trajectory: Trajectory, times_ns: Sequence[int]) -> Trajectory:
    """The trajectory run through from the last of the colour images' times to the first."""
    if not times_ns:
        return trajectory
    times = min(times_ns) + max(times_ns) - trajectory.time_ns[::-1]
    return Trajectory(times, trajectory.quat_wxyz[::-1], trajectory.translation[::-1])


def decimal_commas_note(file_name: str) -> str:
    """One sentence for people about numbers that were read in another notation than is usual."""
    return f"{file_name}: numbers with decimal commas (1,5) are read as such"


def bad_lines_note(file_name: str, bad: Sequence[BadLine], what: str) -> str:
    """One sentence for people about the lines that were left out."""
    first = bad[0]
    return (
        f"{file_name}: {len(bad)} line(s) with unusable {what} left out, the first is line {first.line}: {first.reason}"
    )


def pose_at(trajectory: Trajectory, time_ns: int) -> tuple[FloatArray | None, int]:
    """The pose ``[4, 4]`` at a time, and the distance in ns to the nearest sample; None beyond 20 ms.

    Between two samples the rotation is interpolated spherically and the translation linearly; before the first
    and after the last sample (within 20 ms) that sample is taken.
    """
    times = trajectory.time_ns
    after = int(np.searchsorted(times, time_ns))
    gaps = [(abs(int(times[i]) - time_ns), i) for i in (after - 1, after) if 0 <= i < len(times)]
    gap, nearest = min(gaps)
    if gap > MAX_TIME_DIFFERENCE_NS:
        return None, gap
    if gap == 0 or len(gaps) == 1:
        return pose_from(rotation_from_quat_wxyz(trajectory.quat_wxyz[nearest]), trajectory.translation[nearest]), gap
    before = after - 1
    fraction = (time_ns - int(times[before])) / (int(times[after]) - int(times[before]))
    quat_wxyz = slerp_wxyz(trajectory.quat_wxyz[before], trajectory.quat_wxyz[after], fraction)
    translation = (1 - fraction) * trajectory.translation[before] + fraction * trajectory.translation[after]
    return pose_from(rotation_from_quat_wxyz(quat_wxyz), translation), gap


def turn_rate_at(trajectory: Trajectory, time_ns: int) -> FloatArray | None:
    """How the camera turns at a time: radians a second ``[3]`` in its own frame, over 50 ms; None at the ends."""
    before, _ = pose_at(trajectory, time_ns - TURN_WINDOW_NS // 2)
    after, _ = pose_at(trajectory, time_ns + TURN_WINDOW_NS // 2)
    if before is None or after is None:
        return None
    return so3_log(before[:3, :3].T @ after[:3, :3]) / (TURN_WINDOW_NS * 1e-9)


def nearest_pairs(first_ns: Int64Array, second_ns: Int64Array) -> tuple[list[int | None], Int64Array]:
    """One-to-one association of two ascending lists of times within 20 ms, the nearest pairs first.

    Returns for each of `first_ns` its partner in `second_ns` or None, and the distance (ns) to the nearest of
    all, taken or not.
    """
    right = np.searchsorted(second_ns, first_ns)
    index = np.arange(len(first_ns))
    pairs = []
    nearest = np.full(len(first_ns), np.iinfo(np.int64).max, dtype=np.int64)
    # the partner of a one-to-one match may be the second nearest: look at two on each side
    for shift in (-2, -1, 0, 1):
        j = right + shift
        inside = (j >= 0) & (j < len(second_ns))
        gap = np.abs(second_ns[np.clip(j, 0, len(second_ns) - 1)] - first_ns)
        nearest[inside] = np.minimum(nearest[inside], gap[inside])
        close = inside & (gap <= MAX_TIME_DIFFERENCE_NS)
        pairs += list(zip(gap[close].tolist(), index[close].tolist(), j[close].tolist(), strict=True))
    partner: list[int | None] = [None] * len(first_ns)
    taken: set[int] = set()
    for _, i, j in sorted(pairs):
        if partner[i] is None and j not in taken:
            partner[i] = j
            taken.add(j)
    return partner, nearest
