"""Crops of what changed between two recordings, side by side."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from semdb.pictures.drawing import DPI, FAINT, INK, figure_to_image
from semdb.shown import for_plot
from semdb.types import ImageArray

CELL = (260, 200)  # pixels
COLUMNS = 2  # of changes, two crops each
MOST = 40

Row = tuple[str, ImageArray | None, ImageArray | None]


def draw_crops(rows: Sequence[Row], names: tuple[str, str]) -> ImageArray:
    """The picture as RGB ``[H, W, 3]``: of each change its caption and the crops before and after, `MOST` at most."""
    shown = rows[:MOST]
    lines = -(-len(shown) // COLUMNS)
    width, height = CELL[0] * 2 * COLUMNS, CELL[1] * lines + 40
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    more = "" if len(shown) == len(rows) else f" (the first {len(shown)} of {len(rows)})"
    figure.text(0.01, 1 - 26 / height, for_plot(f"{names[0]} | {names[1]}{more}"), fontsize=11, color=INK)
    for k, (caption, before, after) in enumerate(shown):
        line, column = divmod(k, COLUMNS)
        bottom = 1 - (40 + CELL[1] * (line + 1)) / height
        left = column / COLUMNS
        figure.text(
            left + 0.005, bottom + (CELL[1] - 18) / height, for_plot(caption), fontsize=8, color=INK, va="center"
        )
        for side, image in enumerate((before, after)):
            place = (left + (side + 0.02) / (2 * COLUMNS), bottom + 4 / height)
            axes = figure.add_axes((*place, 0.96 / (2 * COLUMNS), (CELL[1] - 34) / height))
            axes.set_axis_off()
            if image is None:
                axes.text(0.5, 0.5, "-", color=FAINT, ha="center", va="center")
            else:
                axes.imshow(image, interpolation="nearest")
    return figure_to_image(figure)
