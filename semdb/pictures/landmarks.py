"""The landmarks of a map from above: their footprints, where keyframes were taken, and what was found among them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from semdb.pictures.drawing import DPI, FAINT, INK, category_colours, figure_to_image
from semdb.shown import for_plot
from semdb.types import FloatArray, ImageArray

SIZE = (1200, 1000)  # pixels
FOUND = "#c0322b"


@dataclass(frozen=True, slots=True, eq=False)
class Footprint:
    """A landmark on the ground: `corners` ``[4, 2]`` metres along the level axes of its map."""

    id: int
    category: str
    corners: FloatArray
    height: float  # of its upper side along up: what is higher is drawn later
    sure: bool


def draw_landmarks(
    footprints: Sequence[Footprint],
    cameras: FloatArray,
    title: str,
    found: Collection[int] = (),
    arrows: Sequence[tuple[FloatArray, FloatArray]] = (),
) -> ImageArray:
    """The picture as RGB ``[H, W, 3]``; `cameras` ``[n, 2]`` are positions along the level axes, `found` ids.

    `arrows` from ``[2]`` to ``[2]``.
    """
    figure = Figure(figsize=(SIZE[0] / DPI, SIZE[1] / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.06, 0.06, 0.91, 0.87))
    axes.set_aspect("equal", adjustable="datalim")
    colours = category_colours(sorted({item.category for item in footprints}))
    if len(cameras):
        axes.plot(cameras[:, 0], cameras[:, 1], ".", ms=4, color=FAINT, zorder=2)
    for item in sorted(footprints, key=lambda item: (item.id in found, item.height, item.id)):
        hit = item.id in found
        axes.add_patch(
            Polygon(
                item.corners,
                closed=True,
                fc=(*colours[item.category], 0.45),
                ec=FOUND if hit else INK,
                lw=3.0 if hit else 0.9,
                ls="-" if item.sure else ":",
                zorder=6 if hit else 4,
            )
        )
        x, y = item.corners.mean(axis=0)
        axes.text(
            float(x), float(y), for_plot(f"{item.category} {item.id}"), fontsize=9 if hit else 7,
            color=FOUND if hit else INK, ha="center", va="center", zorder=8, clip_on=True,
        )  # fmt: skip
    for start, end in arrows:
        axes.annotate(
            "", xy=(float(end[0]), float(end[1])), xytext=(float(start[0]), float(start[1])), zorder=9,
            arrowprops={"arrowstyle": "->", "color": FOUND, "lw": 1.8},
        )  # fmt: skip
    axes.autoscale_view()
    axes.tick_params(labelsize=9, colors=FAINT)
    figure.text(0.06, 0.955, for_plot(title), fontsize=13, color=INK)
    return figure_to_image(figure)
