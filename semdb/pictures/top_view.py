"""The map from above: keyframes, objects, and where the query was taken."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Polygon
from matplotlib.text import Text

from semdb.pictures.drawing import FAINT, INK, VERDICT_COLOURS, Colour, blank_figure, category_colours, figure_to_image
from semdb.shown import for_plot, number
from semdb.types import FloatArray, ImageArray, Verdict

KEYFRAME = "#9aa5b1"
CANDIDATE = "#2f6fd0"
TRUTH = "#111111"
ESTIMATE = VERDICT_COLOURS[Verdict.LOCALIZED]
MERGE_DISTANCE_M = 0.4
MAX_OBJECTS = 28
HALF_VIEW_DEG = 27.0
CHI2_95_2D = 5.991  # 95 % of a two-dimensional normal distribution lies within sqrt(5.991) standard deviations
LEGEND_HEIGHT = 64
TITLE_HEIGHT = 52


@dataclass(frozen=True, slots=True, eq=False)
class MapObject:
    """An object seen from one or more keyframes: class name, position ``[3]`` in the map in metres, how often.

    A landmark has the corners ``[4, 3]`` of its `footprint`.
    """

    category: str
    position: FloatArray
    count: int = 1
    footprint: FloatArray | None = None


def horizontal_axes(poses: FloatArray) -> FloatArray:
    """Two unit vectors ``[2, 3]`` that span the ground as seen from above, of ``world_from_camera`` ``[n, 4, 4]``.

    Gravity is not recorded: up is against the cameras' mean y axis, and where that says nothing (cameras rolled
    all ways) the direction in which the positions vary least. The first axis is the direction in which the
    cameras moved most.
    """
    down = poses[:, :3, 1].mean(axis=0)
    centred = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    _, _, directions = np.linalg.svd(np.vstack([centred, np.zeros((3, 3))]))
    norm = float(np.linalg.norm(down))
    up = -down / norm if norm > 0.2 else directions[2]
    flat = centred - np.outer(centred @ up, up)
    _, spread, directions = np.linalg.svd(np.vstack([flat, np.zeros((3, 3))]))
    first = directions[0]
    if spread[0] < 1e-6 or abs(first @ up) > 0.5:  # they stood still: take what is across the first view
        helper = poses[0, :3, 0] if abs(poses[0, :3, 0] @ up) < 0.9 else poses[0, :3, 2]
        first = helper - (helper @ up) * up
        first /= np.linalg.norm(first)
    if first[np.argmax(np.abs(first))] < 0:
        first = -first  # SVD leaves the sign open
    return np.stack([first, np.cross(up, first)])


def merge_objects(objects: Sequence[MapObject], distance_m: float = MERGE_DISTANCE_M) -> list[MapObject]:
    """Sightings of one class closer than `distance_m` made one, most seen first; positions are weighted means.

    Objects without a finite position are left out.
    """
    merged: list[MapObject] = []
    for seen in objects:
        if not np.isfinite(seen.position).all():
            continue
        near = [
            (float(np.linalg.norm(known.position - seen.position)), i)
            for i, known in enumerate(merged)
            if known.category == seen.category
        ]
        distance, i = min(near, default=(math.inf, -1))
        if distance > distance_m:
            merged.append(seen)
            continue
        count = merged[i].count + seen.count
        mean = (merged[i].position * merged[i].count + seen.position * seen.count) / count
        merged[i] = MapObject(seen.category, mean, count)
    return sorted(merged, key=lambda item: (-item.count, item.category))


def _worth_showing(objects: Sequence[MapObject]) -> list[MapObject]:
    landmarks = [item for item in objects if item.footprint is not None]
    if landmarks:
        return landmarks
    merged = merge_objects(objects)
    often = [item for item in merged if item.count > 1]
    return (often if len(often) >= 8 else merged)[:MAX_OBJECTS]


def _longest_across(axes_3d: FloatArray, positions: FloatArray) -> FloatArray:
    """The ground axes ``[2, 3]`` turned on the ground so that `positions` ``[n, 3]`` vary most along the first."""
    ground = positions @ axes_3d.T
    _, vectors = np.linalg.eigh(np.cov(ground.T) if len(ground) > 1 else np.eye(2))
    first = vectors[:, 1] if vectors[np.argmax(np.abs(vectors[:, 1])), 1] > 0 else -vectors[:, 1]
    turned: FloatArray = np.stack([first, [-first[1], first[0]]]) @ axes_3d
    return turned


class _Sheet:
    """Ground coordinates in metres to pixels of the picture, the same scale both ways, y up in metres."""

    def __init__(self, points: FloatArray, width: int, height: int) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        span = np.maximum(high - low, 1.0)
        border = 60.0
        room = np.array([width, height - TITLE_HEIGHT - LEGEND_HEIGHT]) - 2 * border
        self.pixels_per_metre = float(min(room / span))
        self._middle = (low + high) / 2
        self.centre = np.array([width / 2, TITLE_HEIGHT + (height - TITLE_HEIGHT - LEGEND_HEIGHT) / 2])

    def place(self, ground: npt.ArrayLike) -> FloatArray:
        offset = (np.asarray(ground, dtype=np.float64) - self._middle) * self.pixels_per_metre
        return np.asarray(self.centre + offset * np.array([1.0, -1.0]))


def draw_top_view(
    keyframe_poses: FloatArray,
    estimated: FloatArray | None = None,
    *,
    covariance: FloatArray | None = None,
    objects: Sequence[MapObject] = (),
    true_pose: FloatArray | None = None,
    candidates: Sequence[int] = (),
    verdict: Verdict = Verdict.LOCALIZED,
    title: str = "map from above",
    colours: Mapping[str, Colour] | None = None,
    size: tuple[int, int] = (1984, 900),
) -> ImageArray:
    """The map from above as RGB ``[H, W, 3]`` of `size` (width, height) pixels.

    `keyframe_poses` ``[n, 4, 4]``, `estimated` and `true_pose` ``[4, 4]`` are ``world_from_camera``; `candidates`
    are positions in `keyframe_poses`, the best first; `covariance` is ``[6, 6]`` (translation first, m) or
    ``[3, 3]``: its 95 % ellipse is drawn, enlarged by a factor that the legend names where it would be too small
    to see. Sightings of an object are merged (`merge_objects`); when many were seen more than once, the others are
    left out. Where any of `objects` has a footprint, those are drawn, all of them, and no others. `colours`
    are class colours of another picture to keep. Raises ValueError without any keyframe.
    """
    if len(keyframe_poses) == 0:
        raise ValueError("a top view needs at least one keyframe")
    shown = _worth_showing(objects)
    extra = [pose for pose in (estimated, true_pose) if pose is not None]
    cameras = np.concatenate([keyframe_poses, np.stack(extra)]) if extra else keyframe_poses
    places = [item.position[None] if item.footprint is None else item.footprint for item in shown]
    positions = np.vstack([cameras[:, :3, 3], *places])
    axes_3d = _longest_across(horizontal_axes(keyframe_poses), positions)
    sheet = _Sheet(positions @ axes_3d.T, *size)
    figure, axes = blank_figure(*size)
    _draw_grid(axes, sheet, size)
    handles = [_marker(KEYFRAME, f"{len(keyframe_poses)} keyframes")]

    small = float(np.clip(0.16 * sheet.pixels_per_metre, 13, 24))
    best = list(candidates)
    rest = [i for i in range(len(keyframe_poses)) if i not in set(best)]
    _draw_wedges(axes, sheet, axes_3d, keyframe_poses[rest], small, KEYFRAME, 2)
    names = category_colours((item.category for item in shown), colours)
    occupied = _object_dots(axes, sheet, axes_3d, shown, names)
    if best:
        _draw_wedges(axes, sheet, axes_3d, keyframe_poses[best], 1.35 * small, CANDIDATE, 4)
        handles.append(_marker(CANDIDATE, "candidates" if len(best) > 1 else "candidate"))
    if true_pose is not None:
        outline = _wedge(sheet, axes_3d, true_pose, 3.2 * small)
        axes.add_patch(Polygon(outline, closed=True, fc="none", ec=TRUTH, lw=1.6, ls=(0, (4, 2)), zorder=7))
        handles.append(Line2D([], [], color=TRUTH, lw=1.6, ls=(0, (4, 2)), label="true camera"))
    if estimated is not None:
        colour = VERDICT_COLOURS[verdict]
        wedge = _wedge(sheet, axes_3d, estimated, 3.2 * small)
        axes.add_patch(Polygon(wedge, closed=True, fc=colour, ec=colour, lw=1.6, alpha=0.55, zorder=6))
        axes.plot(*wedge[0], "o", color=colour, ms=7, mec="white", mew=1.2, zorder=8)
        handles.append(_marker(colour, f"estimated camera ({verdict})"))
        if covariance is not None:
            factor = _draw_ellipse(axes, sheet, axes_3d, estimated, covariance, colour)
            name = "its 95 % ellipse" + (f", drawn {factor} times as large" if factor > 1 else "")
            handles.append(Line2D([], [], color=colour, lw=1.2, label=name))
        occupied.append((wedge.min(axis=0), wedge.max(axis=0)))
    if shown:
        _object_names(axes, sheet, axes_3d, shown, occupied)
        landmarks = _marker(INK, "landmarks", "s")
        dots = _marker(INK, "objects (size: how often seen)", "o")
        handles.append(dots if shown[0].footprint is None else landmarks)
    _draw_scale_bar(axes, sheet, size)
    axes.text(24, 28, for_plot(title), color=INK, fontsize=15, weight="bold", va="center")
    axes.legend(
        handles=handles, loc="lower left", bbox_to_anchor=(0.006, 0.006), ncols=len(handles), frameon=False,
        fontsize=12, labelcolor=INK, handletextpad=0.5, columnspacing=1.8,
    )  # fmt: skip
    return figure_to_image(figure)


def _marker(colour: str, label: str, shape: str = ">") -> Line2D:
    return Line2D([], [], color=colour, marker=shape, ls="", ms=9, label=label)


def _wedge(sheet: _Sheet, axes_3d: FloatArray, pose: FloatArray, length: float) -> FloatArray:
    """Corners ``[3, 2]`` in pixels of a view wedge: the camera first. Shorter where it looks up or down."""
    forward = axes_3d @ pose[:3, 2]
    flat = float(np.linalg.norm(forward))
    heading = math.atan2(forward[1], forward[0]) if flat > 1e-6 else 0.0
    reach = length * max(flat, 0.45) / math.cos(math.radians(HALF_VIEW_DEG))
    tip = sheet.place(axes_3d @ pose[:3, 3])
    angles = heading + np.radians([-HALF_VIEW_DEG, HALF_VIEW_DEG])
    rim = tip + reach * np.column_stack([np.cos(angles), -np.sin(angles)])
    return np.vstack([tip, rim])


def _draw_wedges(
    axes: Axes, sheet: _Sheet, axes_3d: FloatArray, poses: FloatArray, length: float, colour: str, zorder: int
) -> None:
    wedges = [_wedge(sheet, axes_3d, pose, length) for pose in poses]
    axes.add_collection(
        PolyCollection(wedges, facecolors=colour, edgecolors=colour, linewidths=1.0, alpha=0.55, zorder=zorder)
    )
    tips = np.array([wedge[0] for wedge in wedges]).reshape(-1, 2)
    axes.scatter(tips[:, 0], tips[:, 1], s=14, color=colour, linewidths=0, zorder=zorder + 1)


def _draw_ellipse(
    axes: Axes, sheet: _Sheet, axes_3d: FloatArray, pose: FloatArray, covariance: FloatArray, colour: str
) -> int:
    """Draw the 95 % ellipse of the position on the ground; returns by how much it is enlarged (1, 10, 100 ...)."""
    ground = axes_3d @ covariance[:3, :3] @ axes_3d.T
    values, vectors = np.linalg.eigh(ground)
    radii = np.sqrt(CHI2_95_2D * np.maximum(values, 0)) * sheet.pixels_per_metre
    factor = 1
    while 0 < radii[1] * factor < 10 and factor < 1000:
        factor *= 10
    angle = -math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))  # pixels have y down
    centre = sheet.place(axes_3d @ pose[:3, 3])
    axes.add_patch(
        Ellipse(
            (float(centre[0]), float(centre[1])),
            2 * factor * radii[1],
            2 * factor * radii[0],
            angle=angle,
            fc=(1, 1, 1, 0.35),
            ec=colour,
            lw=1.4,
            zorder=9,
        )
    )
    return factor


def _object_dots(
    axes: Axes, sheet: _Sheet, axes_3d: FloatArray, objects: Sequence[MapObject], colours: Mapping[str, Colour]
) -> list[tuple[FloatArray, FloatArray]]:
    """Draw the dots; returns the pixel boxes (low corner, high corner) that names must keep clear of."""
    boxes = []
    for item in objects:
        spot = sheet.place(axes_3d @ item.position)
        if item.footprint is not None:
            ring = sheet.place(item.footprint @ axes_3d.T)
            colour = colours[item.category]
            axes.add_patch(Polygon(ring, closed=True, fc=(*colour, 0.45), ec=INK, lw=0.9, zorder=3))
            boxes.append((spot - 3, spot + 3))
            continue
        radius = _dot_radius(item)
        axes.plot(*spot, "o", ms=2 * radius * 0.72, color=colours[item.category], mec=INK, mew=0.8, zorder=5)
        boxes.append((spot - radius, spot + radius))
    return boxes


def _dot_radius(item: MapObject) -> float:
    return 5.0 + 2.2 * math.sqrt(min(item.count, 16) - 1) if item.count > 1 else 5.0


def _object_names(
    axes: Axes,
    sheet: _Sheet,
    axes_3d: FloatArray,
    objects: Sequence[MapObject],
    occupied: list[tuple[FloatArray, FloatArray]],
) -> None:
    """A name beside each dot where there is room; where there is none the dot's colour has to do."""
    taken = list(occupied)
    for item in objects:
        spot = sheet.place(axes_3d @ item.position)
        text: Text = axes.text(
            0, 0, for_plot(item.category), color=INK, fontsize=11, ha="center", va="center", zorder=10
        )
        extent = text.get_window_extent()
        half = np.array([extent.width, extent.height]) / 2 + 1
        gap = _dot_radius(item) + 3
        inside = [] if item.footprint is None else [(0.0, 0.0)]
        sides = [*inside, (1, 0), (-1, 0), (0, -1), (0, 1), (0.8, -0.8), (0.8, 0.8), (-0.8, -0.8), (-0.8, 0.8)]
        for side in sides:
            middle = spot + np.array(side) * (half + gap)
            low, high = middle - half, middle + half
            if not any((low < other[1]).all() and (other[0] < high).all() for other in taken):
                text.set_position((float(middle[0]), float(middle[1])))
                taken.append((low, high))
                break
        else:
            text.remove()


def scale_bar_metres(pixels_per_metre: float, width: int) -> float:
    """1, 2 or 5 times a power of ten metres, at most an eighth of the picture's width."""
    wanted = width / 8 / pixels_per_metre
    power = 10.0 ** math.floor(math.log10(wanted))
    return max(step * power for step in (1, 2, 5) if step * power <= wanted)


def _draw_grid(axes: Axes, sheet: _Sheet, size: tuple[int, int]) -> None:
    """Faint squares as wide as the scale bar."""
    width, bottom = size[0], size[1] - LEGEND_HEIGHT
    step = scale_bar_metres(sheet.pixels_per_metre, width) * sheet.pixels_per_metre
    centre = sheet.centre
    columns = centre[0] + step * np.arange(-math.ceil(width / step), math.ceil(width / step))
    rows = centre[1] + step * np.arange(-math.ceil(bottom / step), math.ceil(bottom / step))
    lines = [[(x, TITLE_HEIGHT), (x, bottom)] for x in columns if 24 <= x <= width - 24]
    lines += [[(24, y), (width - 24, y)] for y in rows if TITLE_HEIGHT <= y <= bottom]
    axes.add_collection(LineCollection(lines, colors="#edf0f3", linewidths=1.0, zorder=1))


def _draw_scale_bar(axes: Axes, sheet: _Sheet, size: tuple[int, int]) -> None:
    metres = scale_bar_metres(sheet.pixels_per_metre, size[0])
    length = metres * sheet.pixels_per_metre
    right, y = size[0] - 30, size[1] - 26
    axes.plot([right - length, right], [y, y], color=INK, lw=2.5, solid_capstyle="butt", zorder=10)
    for x in (right - length, right):
        axes.plot([x, x], [y - 5, y + 5], color=INK, lw=1.5, zorder=10)
    axes.text(right - length / 2, y - 15, f"{number(metres)} m", color=FAINT, fontsize=12, ha="center", va="center")
