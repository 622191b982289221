"""Pictures: shapes, and that what is drawn is where it should be (pixel probes)."""

from __future__ import annotations

import numpy as np
import pytest

from semdb.geometry import pose_error, pose_from, so3_exp
from semdb.pictures.drawing import (
    GAP,
    HEADER,
    MARGIN,
    PALETTE,
    PANE_HEIGHT,
    category_colours,
    combine_pictures,
    draw_localization,
    localization_facts,
    rgb,
    spread_out,
)
from semdb.pictures.top_view import MapObject, draw_top_view, horizontal_axes, merge_objects, scale_bar_metres
from semdb.types import Detection, FloatArray, ImageArray, Localization, Verdict

SCALE = PANE_HEIGHT / 120


def grey(height: int = 120, width: int = 160) -> ImageArray:
    return np.full((height, width, 3), 100, np.uint8)


def detection(category: str, box: tuple[int, int, int, int], shape: tuple[int, int] = (120, 160)) -> Detection:
    mask = np.zeros(shape, np.bool_)
    mask[box[1] : box[3] + 1, box[0] : box[2] + 1] = True
    return Detection(category, 0.9, np.array(box, np.float32), mask)


def pane_pixel(x: float, y: float, left: int = MARGIN, scale: float = SCALE) -> tuple[int, int]:
    """Row and column on the sheet of a pixel of the image."""
    return int(HEADER + (y + 0.5) * scale), int(left + (x + 0.5) * scale)


def hue_near(picture: ImageArray, at: tuple[int, int], colour: tuple[float, float, float], radius: int = 3) -> float:
    """Smallest distance (0..255 per channel, the largest of three) to `colour` around a pixel."""
    row, column = at
    patch = picture[row - radius : row + radius + 1, column - radius : column + radius + 1].astype(float)
    return float(np.abs(patch - 255 * np.array(colour)).max(axis=2).min())


def test_masks_lines_and_dots_are_where_they_belong() -> None:
    cup, chair = detection("cup", (20, 30, 60, 70)), detection("chair", (100, 60, 150, 110))
    other = detection("cup", (90, 30, 130, 70))
    query_xy = np.array([[40, 50], [120, 20]], np.float32)
    keyframe_xy = np.array([[110, 50], [60, 20]], np.float32)
    arguments = (grey(), [cup, chair], grey(), [other], query_xy, keyframe_xy)
    picture = draw_localization(*arguments, title="t", verdict=Verdict.LOCALIZED)
    colours = category_colours(["cup", "chair"])
    left, right = MARGIN, MARGIN + round(160 * SCALE) + GAP
    assert picture.dtype == np.uint8
    assert picture.shape[1] == 2 * (MARGIN + round(160 * SCALE)) + GAP
    # a translucent mask: its colour mixed into the grey, the same class alike in both images
    mixed = np.array(picture[pane_pixel(30, 60)], float)
    expected = 0.72 * 100 + 0.28 * 255 * np.array(colours["cup"])
    assert np.abs(mixed - expected).max() < 2
    assert np.abs(np.array(picture[pane_pixel(100, 60, right)], float) - expected).max() < 2
    assert (
        np.abs(
            np.array(picture[pane_pixel(130, 95)], float) - 0.72 * 100 - 0.28 * 255 * np.array(colours["chair"])
        ).max()
        < 2
    )
    assert picture[pane_pixel(5, 5)].tolist() == [100, 100, 100]
    # both ends of the match on the cups, and its line in the gap between the images, have the cups' colour
    for at in (pane_pixel(40, 50, left), pane_pixel(110, 50, right)):
        assert hue_near(picture, at, colours["cup"]) < 12
    assert hue_near(picture, (pane_pixel(0, 50)[0], right - GAP // 2), colours["cup"]) < 60
    # the match on the background is grey
    line = picture[pane_pixel(0, 20)[0] - 2 : pane_pixel(0, 20)[0] + 3, right - GAP // 2].astype(int)
    darkest = line[line.sum(axis=1).argmin()]
    assert darkest.max() < 250
    assert darkest.max() - darkest.min() < 15


def test_a_match_between_different_classes_is_drawn_as_background() -> None:
    cup, chair = detection("cup", (20, 30, 60, 70)), detection("chair", (20, 30, 60, 70))
    xy = np.array([[40, 50]], np.float32)
    picture = draw_localization(grey(), [cup], grey(), [chair], xy, xy, title="", verdict=Verdict.AMBIGUOUS)
    assert hue_near(picture, pane_pixel(40, 50), (0.78, 0.80, 0.83)) < 12


def test_images_of_other_sizes_and_no_keyframe() -> None:
    wide = draw_localization(grey(), [], grey(60, 120), [], title="", verdict=Verdict.AMBIGUOUS)
    assert wide.shape[1] == 2 * MARGIN + GAP + round(160 * SCALE) + 1440
    alone = draw_localization(grey(), [], None, [], title="", verdict=Verdict.FAILED, facts=[("reason", "no texture")])
    right = MARGIN + round(160 * SCALE) + GAP
    assert alone[pane_pixel(10, 10, right)].tolist() == [238, 238, 238]
    # the plate of the verdict is red
    red, green, blue = alone[-20:, MARGIN : MARGIN + 40].reshape(-1, 3).min(axis=0)
    chip = alone[-60:-20, MARGIN + 2 : MARGIN + 6].reshape(-1, 3).astype(int)
    assert (np.abs(chip - [0xC0, 0x32, 0x2B]).max(axis=1) < 8).any()
    assert (red, green, blue) == (255, 255, 255)


def test_unequal_point_lists_are_an_error() -> None:
    two, one = np.zeros((2, 2), np.float32), np.zeros((1, 2), np.float32)
    with pytest.raises(ValueError, match="2 points in the query, 1 in the keyframe"):
        draw_localization(grey(), [], grey(), [], two, one, title="", verdict=Verdict.FAILED)


def test_colours_are_stable_and_distinct() -> None:
    assert category_colours(["cup"])["cup"] == category_colours(["cup", "cup"])["cup"]
    ten = category_colours([f"class {i}" for i in range(10)])
    assert len(set(ten.values())) == 10
    assert set(ten.values()) == {rgb(colour) for colour in PALETTE}
    known = {"cup": rgb(PALETTE[0])}
    more = category_colours(["cup", "book", "tv"], known)
    assert more["cup"] == known["cup"]
    assert len(set(more.values())) == 3


def test_spread_out_covers_the_image() -> None:
    rng = np.random.default_rng(0)
    points = np.vstack([rng.normal(0, 1, (500, 2)), [[100, 100], [-100, 50]]])
    chosen = spread_out(points, 10)
    assert len(set(chosen.tolist())) == 10
    assert {500, 501} <= set(chosen.tolist())
    assert spread_out(points[:4], 10).tolist() == [0, 1, 2, 3]


def test_facts_of_a_localization() -> None:
    pose = pose_from(np.eye(3), [1.0, -2.0, 0.5])
    answer = Localization(Verdict.LOCALIZED, "flat", pose, np.eye(6), 0.987, 120, "soft", (), 1.0, 3, "", {})
    facts = dict(localization_facts(answer, pose_error(pose, pose_from(so3_exp([0, 0, 0.01]), [1.0, -2.0, 0.53]))))
    assert facts["position x y z in map flat"] == "1.000  -2.000  0.500 m"
    assert facts["rotation w x y z"].startswith("1.0000  ")
    assert (facts["inliers"], facts["confidence"], facts["off the true pose"]) == ("120", "0.99", "3.0 cm  0.57°")
    failed = Localization(Verdict.FAILED, "flat", None, None, float("nan"), 2, "all", (), 1.0, 3, "too few", {})
    assert localization_facts(failed) == [("inliers", "2"), ("reason", "too few")]


def test_combined_pictures_are_centred_on_white() -> None:
    below = combine_pictures([grey(10, 20), grey(6, 8)], gap=2)
    assert below.shape == (18, 20, 3)
    assert below[11, 0].tolist() == [255, 255, 255]
    assert (below[12:, 6:14] == 100).all()
    assert (below[12:, :6] == 255).all()
    assert combine_pictures([grey(10, 20), grey(6, 8)], vertical=False).shape == (10, 28, 3)
    with pytest.raises(ValueError, match="no pictures"):
        combine_pictures([])


def camera_at(x: float, y: float, heading_deg: float = 0.0) -> FloatArray:
    """A level camera in a world with z up, looking along `heading_deg` from the x axis."""
    heading = np.radians(heading_deg)
    forward = np.array([np.cos(heading), np.sin(heading), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    return pose_from(np.column_stack([np.cross(down, forward), down, forward]), [x, y, 1.5])


def test_ground_axes_of_level_cameras() -> None:
    poses = np.stack([camera_at(x, 0.1 * x, 30 * x) for x in range(5)])
    axes = horizontal_axes(poses)
    assert axes @ axes.T == pytest.approx(np.eye(2), abs=1e-9)
    assert np.cross(axes[0], axes[1]) == pytest.approx([0, 0, 1], abs=1e-9)
    assert axes[0] == pytest.approx(np.array([1, 0.1, 0]) / np.hypot(1, 0.1))


def test_ground_axes_of_one_camera_and_of_rolled_cameras() -> None:
    alone = horizontal_axes(camera_at(0, 0)[None])
    assert alone @ alone.T == pytest.approx(np.eye(2), abs=1e-9)
    assert abs(alone[:, 2]) == pytest.approx([0, 0], abs=1e-9)
    rolled = np.stack([pose_from(so3_exp([0, 0, np.pi * k / 2]), [0, k, (k - 1.5) ** 2]) for k in range(4)])
    axes = horizontal_axes(rolled)  # mean y axis is zero; the positions do not vary along x
    assert abs(np.cross(axes[0], axes[1])) == pytest.approx([1, 0, 0], abs=1e-9)


def test_sightings_of_one_object_are_merged() -> None:
    seen = [
        MapObject("cup", np.array([0.0, 0, 0])),
        MapObject("cup", np.array([0.2, 0, 0])),
        MapObject("book", np.array([0.1, 0, 0])),
        MapObject("cup", np.array([3.0, 0, 0])),
        MapObject("cup", np.array([np.nan, 0, 0])),
    ]
    merged = merge_objects(seen)
    assert [(item.category, item.count) for item in merged] == [("cup", 2), ("book", 1), ("cup", 1)]
    assert merged[0].position == pytest.approx([0.1, 0, 0])


@pytest.mark.parametrize(("pixels_per_metre", "expected"), [(100.0, 1.0), (60.0, 2.0), (49.9, 2.0), (1000.0, 0.1)])
def test_scale_bar(pixels_per_metre: float, expected: float) -> None:
    assert scale_bar_metres(pixels_per_metre, 1000) == pytest.approx(expected)


def centre_of(picture: ImageArray, colour: tuple[int, int, int], tolerance: int = 6) -> FloatArray:
    """Mean (x, y) of the pixels of a colour in the map part of the picture."""
    rows, columns = np.nonzero((np.abs(picture[60:-70].astype(int) - colour) <= tolerance).all(axis=2))
    assert len(rows) > 20
    return np.array([columns.mean(), rows.mean() + 60])


def test_marks_of_the_map_are_where_they_should_be() -> None:
    keyframes = np.stack([camera_at(x, y) for x in (0.0, 4.0) for y in (0.0, 1.0)])
    colours = {"cup": (0.0, 0.0, 1.0), "tv": (1.0, 0.0, 1.0), "book": (0.0, 1.0, 1.0)}
    places = {"cup": [1.0, 0.0, 0.3], "tv": [3.0, 0.0, 0.3], "book": [2.0, 1.0, 0.3]}
    objects = [MapObject(name, np.array(place), 9) for name, place in places.items()]
    picture = draw_top_view(keyframes, objects=objects, colours=colours, size=(1000, 600), title="")
    assert picture.shape == (600, 1000, 3)
    cup, tv, book = (centre_of(picture, colour) for colour in ((0, 0, 255), (255, 0, 255), (0, 255, 255)))
    # 4 m by 1 m with 60 pixels around: the width decides, 220 pixels a metre; seen from above, x right and y up
    assert tv - cup == pytest.approx([2 * 220, 0], abs=3)
    assert book - cup == pytest.approx([220, -220], abs=3)
    assert (cup + tv) / 2 == pytest.approx([500, 52 + (600 - 52 - 64) / 2 + 110], abs=3)


def test_landmarks_are_drawn_with_their_footprints_and_objects_are_not() -> None:
    keyframes = np.stack([camera_at(x, y) for x in (0.0, 4.0) for y in (0.0, 1.0)])
    ring = np.array([[1.0, 0.2, 0], [2.0, 0.2, 0], [2.0, 0.7, 0], [1.0, 0.7, 0]])
    table = MapObject("table", ring.mean(axis=0), 3, ring)
    colours = {"table": (0.0, 0.0, 1.0), "tv": (1.0, 0.0, 1.0)}
    objects = [MapObject("tv", np.array([3.0, 0.5, 0]), 9), table]
    picture = draw_top_view(keyframes, objects=objects, colours=colours, size=(1000, 600), title="")
    blue = (np.abs(picture[60:-70].astype(int) - (140, 140, 255)) <= 8).all(axis=2)  # 0.45 of it over white
    rows, columns = np.nonzero(blue)
    # 1 m by 0.5 m at 220 pixels a metre, the lower left corner at x = 1 m
    assert np.ptp(columns) == pytest.approx(220, abs=4)
    assert np.ptp(rows) == pytest.approx(110, abs=4)
    assert columns.min() == pytest.approx(60 + 220, abs=4)
    assert not (np.abs(picture[60:-70].astype(int) - (255, 0, 255)) <= 8).all(axis=2).any()


def test_estimate_is_in_the_colour_of_its_verdict_and_ellipse_is_enlarged() -> None:
    keyframes = np.stack([camera_at(x, 0.0) for x in range(5)])
    plain = draw_top_view(keyframes, size=(1000, 600))
    covariance = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    pictures = {
        verdict: draw_top_view(
            keyframes, camera_at(2.0, 0.5, 90), covariance=covariance, true_pose=camera_at(2.0, 0.4, 90),
            candidates=[2, 1], verdict=verdict, size=(1000, 600),
        )
        for verdict in (Verdict.LOCALIZED, Verdict.AMBIGUOUS)
    }  # fmt: skip
    green = (np.abs(pictures[Verdict.LOCALIZED].astype(int) - [0x1E, 0x8E, 0x4E]) < 10).all(axis=2).sum()
    orange = (np.abs(pictures[Verdict.AMBIGUOUS].astype(int) - [0xC7, 0x77, 0x00]) < 10).all(axis=2).sum()
    assert green > 60
    assert orange > 60
    assert (plain != pictures[Verdict.LOCALIZED]).any(axis=2).sum() > 2000


def test_ellipse_has_the_size_and_direction_of_the_covariance() -> None:
    keyframes = np.stack([camera_at(x, y) for x in (0.0, 4.0) for y in (0.0, 1.0)])
    covariance = np.diag([0.04, 0.0025, 0.5, 1, 1, 1])  # 0.2 m along x, 0.05 m along y; up does not matter
    there = camera_at(2.0, 0.5, 90)
    without = draw_top_view(keyframes, there, size=(1000, 600))
    picture = draw_top_view(keyframes, there, covariance=covariance, size=(1000, 600))
    rows, columns = np.nonzero((picture != without).any(axis=2)[60:-70])
    # 95 % radii sqrt(5.991) * sigma at 220 pixels a metre
    assert (columns.max() - columns.min()) / 2 == pytest.approx(np.sqrt(5.991) * 0.2 * 220, abs=3)
    assert (rows.max() - rows.min()) / 2 == pytest.approx(np.sqrt(5.991) * 0.05 * 220, abs=3)
    assert columns.mean() == pytest.approx(500, abs=3)


def test_a_long_reason_stays_inside_the_picture() -> None:
    facts = [("reason", "too few pairs " * 60)]
    picture = draw_localization(grey(), [], None, [], title="", verdict=Verdict.FAILED, facts=facts)
    assert (picture[-60:, -MARGIN + 4 :] == 255).all()
    assert (picture[-60:, -3 * MARGIN : -MARGIN] < 128).any()


def test_a_map_without_keyframes_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one keyframe"):
        draw_top_view(np.empty((0, 4, 4)))
