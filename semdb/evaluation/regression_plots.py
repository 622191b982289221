"""The plot of what networks that regress poses make of more frames to learn from."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from semdb.evaluation.methods import ON_KEYFRAMES
from semdb.evaluation.metrics import EvaluationResult
from semdb.evaluation.plots import LABEL_CHARACTERS, SERIES, style_axes
from semdb.pictures.drawing import FAINT
from semdb.shown import for_legend


def regression_plot(results: Sequence[EvaluationResult]) -> Figure:
    """Mean position error of networks over the frames that they learnt from; other methods are levels.

    `results` are of one recording. A network on keyframes only and one on all frames are points of one line.
    """
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    axes = figure.subplots()
    style_axes(axes)
    lines: dict[str, list[tuple[int, float]]] = {}
    for result in results:
        if result.training_frames is not None and result.mean_translation_m is not None:
            name = result.method.removesuffix(ON_KEYFRAMES)
            lines.setdefault(name, []).append((result.training_frames, result.mean_translation_m))
    for number, (name, points) in enumerate(lines.items()):
        x, y = zip(*sorted(points), strict=True)
        axes.plot(x, y, "o-", color=SERIES[number % len(SERIES)], label=for_legend(name, LABEL_CHARACTERS))
    for result in results:
        if result.training_frames is None and result.mean_translation_m is not None:
            level = axes.axhline(result.mean_translation_m, color=FAINT, lw=1.2, ls="--")
            level.set_label("_")
            name = for_legend(f"{result.method}, {result.keyframes} keyframes", LABEL_CHARACTERS)
            place = axes.get_yaxis_transform()
            axes.text(0.99, result.mean_translation_m, name, color=FAINT, ha="right", va="bottom", transform=place)
    axes.set_yscale("log")
    axes.set_xlabel("frames to learn from")
    axes.set_ylabel("mean position error (m)")
    axes.legend(frameon=False)
    return figure
