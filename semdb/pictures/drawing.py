"""Pictures for people: one localization, query and best keyframe side by side. The map from above is in top_view.

Drawn through matplotlib's object API on an Agg canvas, so that nothing global changes and no display is needed.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch
from matplotlib.text import Text

from semdb.geometry import quat_wxyz_from_rotation
from semdb.shown import for_plot, measure
from semdb.types import Detection, Float32Array, ImageArray, IntArray, Keypoints, Localization, Verdict

Colour = tuple[float, float, float]

DPI = 100
PANE_HEIGHT = 720
MARGIN = 24
GAP = 16
HEADER = 76
FOOTER = 88
MASK_OPACITY = 0.28
INK = "#1b2430"
FAINT = "#6b7683"
BACKGROUND_MATCH: Colour = (0.78, 0.80, 0.83)
VERDICT_COLOURS = {
    Verdict.LOCALIZED: "#1e8e4e",
    Verdict.AMBIGUOUS: "#c77700",
    Verdict.COARSE: "#7b4fa3",
    Verdict.FAILED: "#c0322b",
}
# bright and far apart, readable over photographs; red and green verdict tones are left out of it
PALETTE = (
    "#ffb000", "#2f9bff", "#ff5fa2", "#35d07f", "#a77bff", "#ff7a33", "#b5d92f", "#19c8e6", "#f4e04d", "#c98f5a",
)  # fmt: skip


def category_colours(categories: Iterable[str], known: Mapping[str, Colour] | None = None) -> dict[str, Colour]:
    """A colour per class name: the same in every picture where it can be, and no two alike up to 10 classes.

    Classes that are in `known`, the colours of another picture, keep those.
    """
    colours = dict(known or {})
    taken = {slot for slot, colour in enumerate(PALETTE) if rgb(colour) in colours.values()}
    for name in sorted(set(categories) - set(colours)):
        first = int.from_bytes(hashlib.sha256(name.encode("utf-8", "surrogatepass")).digest()[:4], "big") % len(PALETTE)
        free = (slot % len(PALETTE) for slot in range(first, first + len(PALETTE)))
        slot = next((slot for slot in free if slot not in taken), first)
        taken.add(slot)
        colours[name] = rgb(PALETTE[slot])
    return colours


def rgb(colour: str) -> Colour:
    """Red, green, blue 0..1 of ``#rrggbb``."""
    return int(colour[1:3], 16) / 255, int(colour[3:5], 16) / 255, int(colour[5:7], 16) / 255


def blank_figure(width: int, height: int) -> tuple[Figure, Axes]:
    """A white figure of that many pixels, and axes over all of it in pixels, y down."""
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    axes.axis("off")
    return figure, axes


def figure_to_image(figure: Figure) -> ImageArray:
    """The RGB pixels ``[H, W, 3]`` of a figure."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image: ImageArray = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return image


@dataclass(frozen=True, slots=True)
class _Pane:
    """An image placed on the sheet: pixel `xy` of the image is at ``origin + scale * (xy + 0.5)``."""

    left: int
    top: int
    width: int
    height: int
    scale: float

    def place(self, xy: npt.ArrayLike) -> npt.NDArray[np.float64]:
        points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        return (points + 0.5) * self.scale + (self.left, self.top)


def draw_localization(
    query_image: ImageArray,
    query_detections: Sequence[Detection],
    keyframe_image: ImageArray | None,
    keyframe_detections: Sequence[Detection],
    query_xy: Float32Array | None = None,
    keyframe_xy: Float32Array | None = None,
    *,
    title: str,
    verdict: Verdict,
    facts: Sequence[tuple[str, str]] = (),
    query_label: str = "query",
    keyframe_label: str = "best keyframe",
    max_lines: int = 70,
) -> ImageArray:
    """Query and best keyframe side by side with object masks, class names and inlier matches, RGB ``[H, W, 3]``.

    Images are RGB ``[H, W, 3]`` of any sizes (both are drawn 720 pixels high); `query_xy`, `keyframe_xy` ``[m, 2]``
    are the inlier pairs in their pixels. A match has the colour of its class where both ends lie on objects of one
    class, grey elsewhere; of many, `max_lines` spread over the image are drawn as lines, all as dots. `facts` are
    (name, value) pairs for the caption, see `localization_facts`. Without a keyframe its half says so.
    Raises ValueError when the two lists of points differ in length.
    """
    query_points = _points(query_xy)
    keyframe_points = _points(keyframe_xy)
    if len(query_points) != len(keyframe_points):
        raise ValueError(f"{len(query_points)} points in the query, {len(keyframe_points)} in the keyframe")
    colours = category_colours(d.category for d in (*query_detections, *keyframe_detections))
    left = _pane_for(query_image, MARGIN)
    right = _pane_for(query_image if keyframe_image is None else keyframe_image, left.left + left.width + GAP)
    width, height = right.left + right.width + MARGIN, HEADER + PANE_HEIGHT + FOOTER
    sheet = np.full((height, width, 3), 255, np.uint8)
    _paste(sheet, left, query_image, query_detections, colours)
    if keyframe_image is None:
        sheet[right.top : right.top + right.height, right.left : right.left + right.width] = 238
    else:
        _paste(sheet, right, keyframe_image, keyframe_detections, colours)

    figure, axes = blank_figure(width, height)
    axes.imshow(sheet, extent=(0, width, height, 0), interpolation="nearest", aspect="auto", zorder=0)
    if keyframe_image is not None and len(query_points):
        classes = _match_classes(query_points, query_detections, keyframe_points, keyframe_detections)
        _draw_matches(axes, left.place(query_points), right.place(keyframe_points), classes, colours, max_lines)
    _draw_labels(axes, left, query_detections, colours)
    if keyframe_image is None:
        middle = (right.left + right.width / 2, right.top + right.height / 2)
        axes.text(*middle, "no keyframe agrees with the query", color=FAINT, fontsize=17, ha="center", va="center")
    else:
        _draw_labels(axes, right, keyframe_detections, colours)
    axes.text(MARGIN, 26, for_plot(title), color=INK, fontsize=15, weight="bold", va="center")
    for pane, text in ((left, query_label), (right, keyframe_label if keyframe_image is not None else "")):
        axes.text(pane.left, HEADER - 14, for_plot(text), color=FAINT, fontsize=12, va="center")
    _draw_caption(axes, height - FOOTER / 2, verdict, facts)
    return figure_to_image(figure)


def draw_image(
    image: ImageArray, detections: Sequence[Detection], *, title: str, facts: Sequence[tuple[str, str]] = ()
) -> ImageArray:
    """One image with object masks, class names and scores under a `title`, RGB ``[H, W, 3]``.

    `image` is RGB ``[H, W, 3]`` of any size; it is drawn 720 pixels high. `facts` are (name, value) pairs below it.
    """
    colours = category_colours(detection.category for detection in detections)
    pane = _pane_for(image, MARGIN)
    width, height = pane.width + 2 * MARGIN, HEADER + PANE_HEIGHT + (FOOTER if facts else MARGIN)
    sheet = np.full((height, width, 3), 255, np.uint8)
    _paste(sheet, pane, image, detections, colours)
    figure, axes = blank_figure(width, height)
    axes.imshow(sheet, extent=(0, width, height, 0), interpolation="nearest", aspect="auto", zorder=0)
    _draw_labels(axes, pane, detections, colours)
    head = axes.text(MARGIN, HEADER / 2, for_plot(title), color=INK, fontsize=15, weight="bold", va="center")
    _fit(head, width - 2 * MARGIN)
    _draw_facts(axes, MARGIN, height - FOOTER / 2, facts)
    return figure_to_image(figure)


def description_facts(objects: int, keypoints: Keypoints, *, points: bool = True) -> list[tuple[str, str]]:
    """What the caption of a described image says: objects, keypoints, those on objects and, with `points`, in 3D."""
    facts = [
        ("objects", str(objects)),
        ("keypoints", str(len(keypoints))),
        ("on objects", str(int((keypoints.object_index >= 0).sum()))),
    ]
    if points:
        facts.append(("with a 3D point", str(int(np.isfinite(keypoints.points[:, 2]).sum()))))
    return facts


def localization_facts(localization: Localization, error: tuple[float, float] | None = None) -> list[tuple[str, str]]:
    """What the caption of a picture says: position, rotation, inliers, confidence, and the error where it is known.

    `error` is metres and degrees off the true pose.
    """
    facts: list[tuple[str, str]] = []
    pose = localization.world_from_camera
    if pose is not None:
        x, y, z = pose[:3, 3]
        quaternion = "  ".join(f"{value:.4f}" for value in quat_wxyz_from_rotation(pose[:3, :3]))
        where = f" in map {localization.map_name}" if localization.map_name else ""
        facts.append((f"position x y z{where}", f"{x:.3f}  {y:.3f}  {z:.3f} m"))
        facts.append(("rotation w x y z", quaternion))
    facts.append(("inliers", str(localization.inliers)))
    if np.isfinite(localization.confidence):
        facts.append(("confidence", measure(localization.confidence, 2, unless=(0.0, 1.0))))
    if error is not None:
        facts.append(("off the true pose", f"{100 * error[0]:.1f} cm  {error[1]:.2f}°"))
    if pose is None and localization.reason:
        facts.append(("reason", localization.reason))
    return facts


def combine_pictures(pictures: Sequence[ImageArray], *, vertical: bool = True, gap: int = 0) -> ImageArray:
    """Pictures ``[H, W, 3]`` below one another (or side by side), centred on white. Raises ValueError for none."""
    if not pictures:
        raise ValueError("no pictures to combine")
    along, across = (0, 1) if vertical else (1, 0)
    size = max(picture.shape[across] for picture in pictures)
    shape = [0, 0, 3]
    shape[along] = sum(picture.shape[along] for picture in pictures) + gap * (len(pictures) - 1)
    shape[across] = size
    sheet = np.full(shape, 255, np.uint8)
    position = 0
    for picture in pictures:
        offset = (size - picture.shape[across]) // 2
        top, left = (position, offset) if vertical else (offset, position)
        sheet[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
        position += picture.shape[along] + gap
    return sheet


def _points(xy: Float32Array | None) -> npt.NDArray[np.float64]:
    return np.empty((0, 2)) if xy is None else np.asarray(xy, dtype=np.float64).reshape(-1, 2)


def _pane_for(image: ImageArray, left: int) -> _Pane:
    scale = PANE_HEIGHT / image.shape[0]
    return _Pane(left, HEADER, round(image.shape[1] * scale), PANE_HEIGHT, scale)


def _paste(
    sheet: ImageArray, pane: _Pane, image: ImageArray, detections: Sequence[Detection], colours: dict[str, Colour]
) -> None:
    """Put the image with its translucent, outlined masks into its pane of the sheet."""
    size = (pane.width, pane.height)
    enlarging = cv2.INTER_CUBIC if pane.scale > 1 else cv2.INTER_AREA
    picture = cv2.resize(image, size, interpolation=enlarging).astype(np.float32)
    outlines = []
    for detection in sorted(detections, key=lambda d: -int(d.mask.sum())):  # small objects stay on top
        soft = cv2.resize(detection.mask.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        inside = soft > 0.5
        colour = 255 * np.array(colours[detection.category], np.float32)
        picture[inside] = (1 - MASK_OPACITY) * picture[inside] + MASK_OPACITY * colour
        contours, _ = cv2.findContours(inside.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        outlines.append((contours, tuple(float(value) for value in colour)))
    drawn = np.ascontiguousarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
    for contours, line in outlines:
        cv2.drawContours(drawn, contours, -1, line, 2, cv2.LINE_AA)
    sheet[pane.top : pane.top + pane.height, pane.left : pane.left + pane.width] = drawn


def _object_at(xy: npt.NDArray[np.float64], detections: Sequence[Detection]) -> list[str | None]:
    """The class of the smallest object under each point, None on the background."""
    names: list[str | None] = [None] * len(xy)
    for detection in sorted(detections, key=lambda d: -int(d.mask.sum())):
        height, width = detection.mask.shape
        columns = np.clip(np.rint(xy[:, 0]).astype(int), 0, width - 1)
        rows = np.clip(np.rint(xy[:, 1]).astype(int), 0, height - 1)
        for i in np.flatnonzero(detection.mask[rows, columns]):
            names[i] = detection.category
    return names


def _match_classes(
    query_xy: npt.NDArray[np.float64],
    query_detections: Sequence[Detection],
    keyframe_xy: npt.NDArray[np.float64],
    keyframe_detections: Sequence[Detection],
) -> list[str | None]:
    ends = zip(_object_at(query_xy, query_detections), _object_at(keyframe_xy, keyframe_detections), strict=True)
    return [first if first == second else None for first, second in ends]


def spread_out(xy: npt.NDArray[np.float64], count: int) -> IntArray:
    """Positions of at most `count` of the points ``[n, 2]``, each the farthest from those chosen before."""
    if len(xy) <= count:
        return np.arange(len(xy), dtype=np.int32)
    chosen = np.zeros(count, dtype=np.int32)
    chosen[0] = int(np.argmin(np.linalg.norm(xy - np.median(xy, axis=0), axis=1)))
    nearest = np.linalg.norm(xy - xy[chosen[0]], axis=1)
    for i in range(1, count):
        chosen[i] = int(np.argmax(nearest))
        nearest = np.minimum(nearest, np.linalg.norm(xy - xy[chosen[i]], axis=1))
    return np.sort(chosen)


def _draw_matches(
    axes: Axes,
    first: npt.NDArray[np.float64],
    second: npt.NDArray[np.float64],
    classes: Sequence[str | None],
    colours: dict[str, Colour],
    max_lines: int,
) -> None:
    edge = [BACKGROUND_MATCH if name is None else colours[name] for name in classes]
    shown = spread_out(first, max_lines)
    # the background first, so that objects lie on top
    shown = np.array(sorted(shown, key=lambda i: classes[i] is not None), dtype=np.int32)
    segments = np.stack([first[shown], second[shown]], axis=1)
    alpha = [0.42 if classes[i] is None else 0.85 for i in shown]
    rgba = [(*edge[i], a) for i, a in zip(shown, alpha, strict=True)]
    axes.add_collection(LineCollection(list(segments), colors=rgba, linewidths=0.9, zorder=2))
    for ends in (first, second):
        axes.scatter(ends[:, 0], ends[:, 1], s=10, c=edge, edgecolors=INK, linewidths=0.5, zorder=3)


def _draw_labels(axes: Axes, pane: _Pane, detections: Sequence[Detection], colours: dict[str, Colour]) -> None:
    """A plate with class and score at the top of each object, moved down until it covers no other plate."""
    taken: list[tuple[float, float, float, float]] = []
    for detection in sorted(detections, key=lambda d: -d.score):
        text = for_plot(f"{detection.category} {detection.score:.2f}", int((pane.width - 11.0) / 8.3))
        plate_width, plate_height = 11.0 + 8.3 * len(text), 22.0
        x, y = pane.place(detection.box[:2])[0]
        x = max(pane.left, min(float(x), pane.left + pane.width - plate_width))
        y = float(np.clip(y, pane.top, pane.top + pane.height - plate_height))
        while any(_overlap((x, y, x + plate_width, y + plate_height), other) for other in taken):
            y += 4.0
        if y + plate_height > pane.top + pane.height:
            continue  # no room left: the mask and its colour still say what it is
        taken.append((x, y, x + plate_width, y + plate_height))
        colour = colours[detection.category]
        plate = FancyBboxPatch(
            (x + 2, y + 2), plate_width - 4, plate_height - 4, boxstyle="round,pad=2", fc=INK, ec="none", alpha=0.86
        )
        axes.add_patch(plate)
        plate.set_zorder(4)
        axes.text(
            x + plate_width / 2, y + plate_height / 2 + 0.5, text, color=colour, fontsize=10, weight="bold",
            family="DejaVu Sans", ha="center", va="center", zorder=5,
        )  # fmt: skip


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _draw_caption(axes: Axes, y: float, verdict: Verdict, facts: Sequence[tuple[str, str]]) -> None:
    chip = axes.text(
        MARGIN + 10, y, str(verdict), color="white", fontsize=15, weight="bold", va="center",
        bbox={"boxstyle": "round,pad=0.45", "fc": VERDICT_COLOURS[verdict], "ec": "none"},
    )  # fmt: skip
    _draw_facts(axes, _right_edge(chip) + 48, y, facts)


def _draw_facts(axes: Axes, x: float, y: float, facts: Sequence[tuple[str, str]]) -> None:
    """Names over values from `x` on, side by side."""
    for name, value in facts:
        head = axes.text(x, y - 15, for_plot(name), color=FAINT, fontsize=10.5, va="center")
        body = axes.text(x, y + 11, for_plot(value), color=INK, fontsize=14, va="center")
        room = axes.get_xlim()[1] - MARGIN - x
        _fit(body, room)
        x = max(_right_edge(head), _right_edge(body)) + 40


def _right_edge(text: Text) -> float:
    """Where a text ends, in pixels of the sheet (the axes are in pixels)."""
    return float(text.get_window_extent().x1)


def _fit(text: Text, room: float) -> None:
    """Make a text smaller, then shorter, until it is at most `room` pixels wide."""
    width = float(text.get_window_extent().width)
    if width <= room:
        return
    text.set_fontsize(max(9.5, 14 * room / width))
    width = float(text.get_window_extent().width)
    kept = text.get_text()[: math.ceil(len(text.get_text()) * min(1.0, room / width))]
    text.set_text(kept)
    while kept and text.get_window_extent().width > room:
        kept = kept[: int(0.97 * len(kept))].rstrip()
        text.set_text(kept + " …")
