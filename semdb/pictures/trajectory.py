"""A trajectory from above, before and after its loops were closed, with the closures and the drift that each shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from semdb.geometry import invert_pose
from semdb.pictures.drawing import DPI, FAINT, INK, figure_to_image
from semdb.pictures.top_view import horizontal_axes
from semdb.shown import for_plot
from semdb.types import FloatArray, ImageArray

SIZE = (1984, 1000)  # pixels
PANEL = (0.455, 0.54)  # share of the picture
WIDE = PANEL[0] * SIZE[0] / (PANEL[1] * SIZE[1])
BEFORE, AFTER, CLOSURE, REFUSED, TRUE = "#9aa5b1", "#2f6fd0", "#1e8e4e", "#c0322b", "#111111"


@dataclass(frozen=True, slots=True)
class ShownClosure:
    """A closure between two positions of the path: how far odometry was off there, and whether it counts.

    `name` says between which frames, for people; without one it is the positions.
    """

    first: int
    second: int
    metres: float
    degrees: float
    accepted: bool = True
    name: str = ""


def draw_trajectory(
    before: FloatArray,
    after: FloatArray,
    keyframes: Sequence[int],
    closures: Sequence[ShownClosure],
    *,
    title: str,
    true: FloatArray | None = None,
) -> ImageArray:
    """The picture as RGB ``[H, W, 3]``.

    `before` and `after` ``[n, 4, 4]`` are the same frames by odometry alone and in the end; `keyframes` and the
    positions of `closures` count them. `true` ``[n, 4, 4]`` are their recorded poses where there are some, laid on each
    path as well as one motion can.
    """
    figure = Figure(figsize=(SIZE[0] / DPI, SIZE[1] / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    ground = horizontal_axes(after)
    laid = after[0] @ invert_pose(before[0]) @ before
    recorded = [] if true is None else [_laid_on(true, path) for path in (laid, after)]
    corners = np.concatenate([path[:, :3, 3] @ ground.T for path in (laid, after, *recorded)])
    panels = ((0.03, laid, BEFORE, "odometry alone"), (0.515, after, AFTER, "loops closed, all keyframes adjusted"))
    for number, (left, path, colour, name) in enumerate(panels):
        axes = figure.add_axes((left, 0.36, *PANEL))
        _draw_path(axes, path, ground, colour, keyframes)
        _draw_closures(axes, path, ground, closures)
        if recorded:
            _draw_line(axes, recorded[number], ground, TRUE, 0.8, "recorded", (0, (4, 2)))
        _frame(axes, corners, name)
    _draw_drifts(figure.add_axes((0.06, 0.09, 0.9, 0.19)), closures)
    figure.text(0.012, 0.965, for_plot(title), color=INK, fontsize=15, weight="bold", va="center")
    return figure_to_image(figure)


def _laid_on(true: FloatArray, path: FloatArray) -> FloatArray:
    """Recorded poses moved so that they lie on estimated ones as well as they can."""
    positions, target = true[:, :3, 3], path[:, :3, 3]
    u, _, vt = np.linalg.svd((target - target.mean(axis=0)).T @ (positions - positions.mean(axis=0)))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    motion = np.eye(4)
    motion[:3, :3] = rotation
    motion[:3, 3] = target.mean(axis=0) - rotation @ positions.mean(axis=0)
    return np.asarray(motion @ true)


def _draw_line(
    axes: Axes, path: FloatArray, ground: FloatArray, colour: str, width: float, name: str, style: object = "-"
) -> None:
    x, y = (path[:, :3, 3] @ ground.T).T
    axes.plot(x, y, color=colour, lw=width, ls=style, label=name, zorder=3)


def _draw_path(axes: Axes, path: FloatArray, ground: FloatArray, colour: str, keyframes: Sequence[int]) -> None:
    _draw_line(axes, path, ground, colour, 1.6, "path")
    x, y = (path[list(keyframes), :3, 3] @ ground.T).T
    axes.scatter(x, y, s=16, color=colour, label=_counted(len(keyframes), "keyframe"), zorder=4)
    start = path[0, :3, 3] @ ground.T
    axes.scatter(
        [start[0]], [start[1]], s=70, facecolors="none", edgecolors=INK, linewidths=1.4, label="start", zorder=5
    )


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}"


def _draw_closures(axes: Axes, path: FloatArray, ground: FloatArray, closures: Sequence[ShownClosure]) -> None:
    for accepted, colour in ((True, CLOSURE), (False, REFUSED)):
        shown = [closure for closure in closures if closure.accepted == accepted]
        if not shown:
            continue
        ends = np.array([[path[c.first, :3, 3] @ ground.T, path[c.second, :3, 3] @ ground.T] for c in shown])
        label = _counted(len(shown), "closure") if accepted else f"{len(shown)} contradicted"
        axes.add_collection(LineCollection(list(ends), colors=colour, linewidths=0.9, alpha=0.7, label=label))


def _frame(axes: Axes, corners: FloatArray, name: str) -> None:
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, spread = (low + high) / 2, np.maximum(high - low, 0.05) * 0.55
    half = max(spread[0] / WIDE, spread[1])  # of the height: a metre is as long both ways
    axes.set_xlim(middle[0] - half * WIDE, middle[0] + half * WIDE)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_xlabel("m", color=FAINT, loc="right", labelpad=-2)
    axes.set_title(name, color=INK, fontsize=13, loc="left")
    axes.tick_params(colors=FAINT, labelsize=9)
    axes.grid(color="#edf0f3", linewidth=1.0)
    axes.set_axisbelow(True)
    for spine in axes.spines.values():
        spine.set_color("#d5dae0")
    axes.legend(loc="upper right", fontsize=10, frameon=False, labelcolor=INK)


def _draw_drifts(axes: Axes, closures: Sequence[ShownClosure]) -> None:
    shown = [closure for closure in closures if closure.accepted]
    title = "drift of odometry that each closure (frame-frame) shows, in the order of the later one"
    axes.set_title(title, color=INK, fontsize=12, loc="left")
    for spine in ("top", "right"):
        axes.spines[spine].set_visible(False)
    axes.tick_params(colors=FAINT, labelsize=9)
    axes.set_ylabel("cm", color=FAINT)
    if not shown:
        axes.set_xticks([])
        axes.text(0.5, 0.5, "no closures", color=FAINT, ha="center", va="center", transform=axes.transAxes)
        return
    order = sorted(shown, key=lambda closure: (max(closure.first, closure.second), min(closure.first, closure.second)))
    places = np.arange(len(order))
    axes.bar(places, [100 * closure.metres for closure in order], color=CLOSURE, width=0.6)
    step = max(1, len(order) // 24)
    names = [for_plot(c.name or f"{c.first}-{c.second}") for c in order[::step]]
    axes.set_xticks(places[::step], names, rotation=40, ha="right")
