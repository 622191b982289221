"""Tables, plots and the report of an evaluation."""

from __future__ import annotations

import base64
import csv
import io
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from rich.console import Console

from semdb.errors import UsageError
from semdb.evaluation.averages import averages
from semdb.evaluation.comparisons import regression_grid, table_1, table_3, table_4
from semdb.evaluation.confidence_plots import answers, confidence_plot
from semdb.evaluation.failures import explain, sharpness
from semdb.evaluation.methods import ABLATION
from semdb.evaluation.metrics import EvaluationResult, QueryResult, error_figures, summarise
from semdb.evaluation.plots import (
    SERIES,
    cumulative_plot,
    cumulative_shares,
    figure_png,
    inlier_plot,
    series_names,
    timing_plot,
    trajectory_plot,
)
from semdb.evaluation.published import PAPER_TABLE_3
from semdb.evaluation.refined_truth import Disagreement
from semdb.evaluation.regression_plots import regression_plot
from semdb.evaluation.report import write_report
from semdb.evaluation.tables import (
    HEADERS,
    average_grid,
    by_keyframes,
    grid_markdown,
    result_row,
    results_markdown,
    results_table,
    retrieval_grid,
    rich_table,
)
from semdb.evaluation.worst import worst_queries
from semdb.geometry import pose_from, so3_exp
from semdb.types import ModelInfo, Verdict


def query(index: int, metres: float | None, verdict: Verdict = Verdict.LOCALIZED, reason: str = "") -> QueryResult:
    truth = pose_from(so3_exp([0, 0.05 * index, 0]), [0.1 * index, 0.0, np.sin(index)])
    degrees = None if metres is None else 20 * metres
    return QueryResult(
        f"rgb/{index}.png", index, verdict, metres, degrees, 3, 10 * index, 0.9, "filtered", 0.25, 3,
        {"match": 5.0, "total": 40.0}, reason, true_world_from_camera=truth,
    )  # fmt: skip


def result(method: str = "semdb", keyframes: int = 25, recording: str = "room") -> EvaluationResult:
    queries = [query(i, 0.01 * i) for i in range(1, 8)]
    queries += [
        query(8, 0.6),
        query(9, 0.9, Verdict.AMBIGUOUS, "<b>two places</b>"),
        query(10, None, Verdict.FAILED, "9 inliers"),
    ]
    models = (ModelInfo("detector", "recorded", ""), ModelInfo("features", "surf", "ab" * 32))
    return summarise(
        queries, recording=recording, protocol="paper", method=method, models=models, frames=250, keyframes=keyframes
    )


EMPTY = summarise([], recording="room", protocol="paper", method="none", models=(), frames=9, keyframes=9)


def printed(renderable: object, width: int = 80) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(renderable)
    return console.export_text()


def test_shares_count_queries_without_a_pose_as_never_within() -> None:
    shares = cumulative_shares([0.1, 0.3, None], 4, np.array([0.0, 0.1, 0.2, 0.3, 9.0]))
    assert shares.tolist() == [0.0, 0.25, 0.25, 0.5, 0.5]
    assert cumulative_shares([], 0, np.array([1.0])).tolist() == [0.0]


def test_curves_of_the_cumulative_plot() -> None:
    figure = cumulative_plot([result(), result("cnn")])
    left, right, near, turned_near = figure.axes
    assert (left.get_xlim(), right.get_xlim()) == ((0, 0.5), (0, 10))
    assert (near.get_xlim(), turned_near.get_xlim()) == ((0, 0.05), (0, 2.5))
    assert np.asarray(near.get_lines()[0].get_ydata(), float)[-1] == pytest.approx(0.5)  # 1 to 5 cm
    curve = left.get_lines()[0]
    x, y = np.asarray(curve.get_xdata(), float), np.asarray(curve.get_ydata(), float)
    assert (x[0], x[-1]) == (0.0, 0.5)
    assert y[np.searchsorted(x, 0.045)] == pytest.approx(0.4)  # 1 to 4 cm of ten queries
    assert y[-1] == pytest.approx(0.7)  # neither 0.6 m, nor the ambiguous, nor the failed one
    turned = right.get_lines()[0]
    assert np.asarray(turned.get_ydata(), float)[-1] == pytest.approx(0.7)
    marks = [line.get_xydata().tolist() for line in (*left.get_lines(), *right.get_lines()) if line.get_marker() == "D"]
    assert marks == [[[0.3, 0.9]], [[2.5, 0.8]]]
    [legend] = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["semdb, 25 keyframes", "cnn, 25 keyframes"]


@pytest.mark.parametrize("count", [1, 16])
def test_legends_are_whole_and_hide_no_curve(count: int) -> None:
    results = [result("sift-reference", 10 + n, "tum_rgbd_dataset_freiburg1_rpy") for n in range(count)]
    confidences = [(name, *answers(one)) for name, one in zip(series_names(results), results, strict=True)]
    timing = timing_plot([result(), *results])  # long names
    assert timing is not None
    for figure in (cumulative_plot(results), timing, confidence_plot(confidences)):
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        whole = figure.bbox
        legends = [*figure.legends, *(axes.get_legend() for axes in figure.axes if axes.get_legend())]
        assert legends
        for legend in legends:
            box = legend.get_window_extent()
            assert box.x0 >= whole.x0
            assert box.x1 <= whole.x1
            assert box.y0 >= whole.y0
            assert box.y1 <= whole.y1
            assert count == 1 or not any(box.overlaps(axes.bbox) for axes in figure.axes)


def test_curve_pixels_have_the_colour_of_the_series() -> None:
    png = figure_png(cumulative_plot([result()]))
    image = cv2.cvtColor(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
    wanted = [int(SERIES[0][i : i + 2], 16) for i in (1, 3, 5)]
    near = (np.abs(image.astype(int) - wanted) < 8).all(axis=2)
    half = image.shape[1] // 2
    assert near[:, :half].sum() > 500
    assert near[:, half:].sum() > 500


def test_series_are_named_by_recording_where_there_are_several() -> None:
    assert series_names([result(), result(recording="desk")]) == [
        "room, semdb, 25 keyframes",
        "desk, semdb, 25 keyframes",
    ]


def test_trajectory_marks_every_verdict() -> None:
    figure = trajectory_plot(result())
    assert figure is not None
    labels = figure.axes[0].get_legend_handles_labels()[1]
    assert labels == ["false localization (1)", "ambiguous (1)", "failed (1)"]
    assert len(figure.axes[0].collections[0].get_offsets()) == 8  # localized
    assert trajectory_plot(EMPTY) is None


def test_inlier_plot_puts_queries_without_pose_above_all_others() -> None:
    axes = inlier_plot(result()).axes[0]
    localized, ambiguous, failed = (np.asarray(spots.get_offsets()) for spots in axes.collections)
    assert len(localized) == 8
    assert localized[0] == pytest.approx([10, 0.01])
    assert ambiguous[0] == pytest.approx([90, 0.9])
    assert failed[0, 1] > 1.1 * max(localized[:, 1].max(), ambiguous[:, 1].max())
    assert len(inlier_plot(EMPTY).axes[0].collections) == 0


def test_table_rows_and_markdown() -> None:
    row = dict(zip(HEADERS, result_row(result()), strict=True))
    assert row["localized"] == "80.0 %"
    assert row["false"] == "1"
    assert row["median m / °"] == "0.0450 / 0.90"
    assert row["5 cm 5°"] == "50.0 %"
    assert row["ms p50 / p95"] == "40 / 40"
    assert set(result_row(EMPTY)[5:]) == {"-", "0", "- / -"}
    lines = results_markdown([result(), EMPTY]).splitlines()
    assert len(lines) == 4
    assert len({len(line) for line in lines}) == 1
    assert lines[1].count("|") == len(HEADERS) + 1


def test_tables_fit_a_terminal_of_80_characters() -> None:
    three = [result("semdb", n) for n in (12, 25, 50)]
    for renderable in (
        results_table(three, "Evaluation"),
        results_table([*three, result("cnn"), result(recording="desk")], "Evaluation"),
    ):
        text = printed(renderable)
        assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
        assert "0.0450 / 0.90" in text
        assert "…" not in text


def test_order_by_number_of_keyframes() -> None:
    ordered = by_keyframes([result(keyframes=50), result("cnn", 12), result(keyframes=12)])
    assert [(item.method, item.keyframes) for item in ordered] == [("semdb", 12), ("semdb", 50), ("cnn", 12)]


def test_figures_of_the_paper() -> None:
    sequences = [row for row in PAPER_TABLE_3 if row.keyframes is not None]
    assert len(sequences) == 14
    office = next(row for row in sequences if row.sequence.endswith("office room kt1"))
    assert (office.keyframes, office.test_frames, office.success_rate) == (47, 600, 0.7794)
    text = grid_markdown(table_3([result()]))
    assert "freiburg1_room" in text
    assert text.splitlines()[-1].startswith("| room ")


def test_worst_queries_first() -> None:
    order = [item.frame_index for item in worst_queries(result(), 4)]
    assert order == [8, 9, 10, 7]


class Page(HTMLParser):
    """Collects the tags, and checks that they are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_report_is_complete_and_self_contained(tmp_path: Path) -> None:
    picture = cv2.imencode(".jpg", np.full((20, 30, 3), 200, np.uint8))[1].tobytes()
    results = [result(keyframes=50), result(keyframes=12), result(recording="desk")]
    results[0] = replace(results[0], models=(ModelInfo("features", "sift", ""),), pictures={("", 8): picture})
    steps: list[tuple[int, int]] = []
    page = write_report(
        tmp_path / "new" / "report", results, settings={"SEMDB_FEATURES": "surf <x>"},
        failures={"kitchen": "no <depth>"}, progress=lambda done, total: steps.append((done, total)),
    )  # fmt: skip
    folder = page.parent
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(
        ["index.html", "results.json", "averages.json", "queries.csv", "errors-1.png", "errors-2.png", "timing.png"]
        + ["confidence-1.png", "confidence-2.png"]
        + [f"{kind}-{n}.png" for kind in ("trajectory", "inliers") for n in (1, 2, 3)]
    )
    assert steps == [(1, 3), (2, 3), (3, 3)]
    assert [item["keyframes"] for item in json.loads((folder / "results.json").read_text())] == [25, 12, 50]
    with (folder / "queries.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 30
    text = page.read_text(encoding="utf-8")
    assert "http:" not in text
    assert "https:" not in text
    parser = Page()
    parser.feed(text)
    assert parser.open == []
    images = [attributes for tag, attributes in parser.seen if tag == "img"]
    assert len(images) == 2 + 1 + 2 + 2 * 3 + 1  # errors, time, confidence, two per result, one query
    assert sum(str(image["src"]).startswith("data:image/png;base64,") for image in images) == len(images) - 1
    assert f"data:image/jpeg;base64,{base64.b64encode(picture).decode()}" in text
    assert not any(tag in ("script", "link", "iframe") for tag, _ in parser.seen)
    links = [attributes["href"] for tag, attributes in parser.seen if tag == "a"]
    places = {f"#{attributes['id']}" for tag, attributes in parser.seen if tag == "h2"}
    assert set(links) == places
    assert "surf &lt;x&gt;" in text
    assert "<b>kitchen</b> was not evaluated: no &lt;depth&gt;" in text
    assert "<dt>features</dt><dd>surf abababababab, sift</dd>" in text
    assert "&lt;b&gt;two places&lt;/b&gt;" in text
    assert "Table 1" in text
    assert "PoseNet" in text


def test_report_of_an_empty_result(tmp_path: Path) -> None:
    page = write_report(tmp_path, [EMPTY])
    assert json.loads((tmp_path / "results.json").read_text())["success_rate"] is None
    assert "none, 9 keyframes" in page.read_text(encoding="utf-8")


def test_report_of_an_ablation_and_two_truths(tmp_path: Path) -> None:
    figures = Disagreement(14, 13, 0.01, 0.02, 0.03, 0.1, 0.2, 0.3, 0.004, 0.05, 1.001, 0.026, 1.5, 0.6)
    results = [replace(EMPTY, method=name) for _, _, name in ABLATION]
    results[0] = replace(results[0], disagreement=figures, other_errors=error_figures([query(1, 0.02)]))
    text = write_report(tmp_path, results).read_text(encoding="utf-8")
    assert "What each layer brings" in text
    assert "Ablation on room, 9 keyframes, 0 queries" in text
    assert "<td>1.50 / 0.60</td><td>1.0010</td><td>26 ms</td>" in text
    assert "<td>0.0200 / 0.40</td><td>100.0 %</td>" in text


def test_report_errors_say_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least one result"):
        write_report(tmp_path, [])
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"cannot be written to .*file"):
        write_report(tmp_path / "file", [EMPTY])


def test_sequences_of_the_paper_stand_below_its_rows() -> None:
    kt0 = replace(result(recording="lr_kt0"), sequence="ICL-NUIM living room kt0")
    kt1 = replace(result(recording="lr_kt1"), sequence="ICL-NUIM living room kt1", median_translation_m=0.015)
    grid = table_3([kt0, kt1], only_evaluated=True)
    assert [row[:2] for row in grid.rows] == [
        ("ICL-NUIM living room kt0", "the paper"),
        ("ICL-NUIM living room kt0", "semdb"),
        ("ICL-NUIM living room kt1", "the paper"),
        ("ICL-NUIM living room kt1", "semdb"),
        ("ICL-NUIM, all", "the paper"),
        ("ICL-NUIM, all", "Chen et al."),
        ("ICL-NUIM, mean of 2", "semdb"),
    ]
    assert grid.ours == {1, 3, 6}
    assert grid.rows[6][5] == "0.0300 / 0.90"
    assert len(table_3([kt0, result(recording="desk")]).rows) == len(PAPER_TABLE_3) + 2
    rooms = table_4([kt0, kt1])
    assert rooms.rows[-1][:3] == ("semdb, this run", "0.1100 / 2.20 (2 of 4)", "-")
    assert rooms.rows[-1][3:] == ("0.0300 / 0.90 (2 of 4)", "-")
    assert rooms.rows[0] == ("PoseNet", "0.6000 / 3.64", "0.4600 / 2.97", "-", "-")
    other = replace(kt0, truth="refined", keyframes_asked=12, mean_translation_m=0.5)
    assert [row[:3] for row in table_4([kt0, other]).rows[-2:]] == [
        ("semdb, this run", "0.1100 / 2.20 (1 of 4)", "-"),
        ("semdb (refined poses), this run, 12 keyframes each", "0.5000 / 2.20 (1 of 4)", "-"),
    ]
    assert table_1([kt0]).rows[-1] == ("ICL-NUIM living room kt0", "this run", "250", "25", "10")


def test_networks_stand_beside_structure_with_what_they_learnt_from() -> None:
    few, many = (
        replace(
            result("posenet"), training_frames=frames, mean_translation_m=mean, mean_rotation_deg=9.0,
            median_translation_m=0.3, recall={**result().recall, "0.3m": 0.25},
        )
        for frames, mean in ((25, 0.55), (180, 0.22))
    )  # fmt: skip
    fixed = replace(result("mean-pose"), mean_translation_m=1.1)
    grid = regression_grid([result(), few, many, fixed, result(recording="desk")])
    assert [row[:4] for row in grid.rows] == [
        ("room", "semdb", "25", "-"),
        ("room", "posenet", "25", "25"),
        ("room", "posenet", "25", "180"),
        ("room", "mean-pose", "25", "-"),
    ]
    assert grid.rows[1][4:] == ("0.5500 / 9.00", "0.3000 / 0.90", "25.0 %", "5.0")
    assert [row[-1] for row in grid.rows] == ["1.0", "5.0", "2.0", "10.0"]
    assert regression_grid([result(), fixed]).rows == []
    [axes] = regression_plot([result(), few, many, fixed]).axes
    [line, *levels] = axes.lines
    assert list(line.get_xdata()) == [25, 180]
    assert list(line.get_ydata()) == [0.55, 0.22]
    assert [level.get_ydata()[0] for level in levels] == pytest.approx([0.11, 1.1])


def test_averages_are_plain_means_over_recordings() -> None:
    room, desk = result(), replace(result(recording="desk"), median_translation_m=0.005, success_rate=1.0)
    [mean] = averages([room, desk])
    assert (mean.name, mean.sequences, mean.queries) == ("all recordings", 2, 20)
    assert mean.median_translation_m == pytest.approx((0.045 + 0.005) / 2)
    assert mean.success_rate == pytest.approx(0.9)
    assert averages([room]) == []
    assert averages([room, replace(desk, method="cnn")]) == []
    assert averages([room, replace(desk, median_translation_m=None)])[0].median_translation_m is None
    assert average_grid(averages([room, desk])).rows[0][:3] == ("all recordings", "semdb", "2")
    mixed = averages([replace(one, method=name) for one in (room, desk) for name in ("chen", "paper", "semdb+depth")])
    assert [mean.method for mean in mixed] == ["semdb+depth", "paper", "chen"]
    assert retrieval_grid([room]).rows == []
    assert "all recordings" in printed(rich_table(average_grid([mean])), 200)


def test_the_averages_of_the_paper_are_made_the_same_way() -> None:
    """Its rows "all" repeat as plain means of its sequences, medians too, within one unit of the last digit."""
    for collection in ("ICL-NUIM", "TUM RGB-D"):
        rows = [row for row in PAPER_TABLE_3 if row.collection == collection and row.test_frames]
        [whole] = [row for row in PAPER_TABLE_3 if row.sequence == f"{collection}, all" and row.method == "the paper"]
        for field in ("median_translation_m", "median_rotation_deg", "mean_translation_m", "mean_rotation_deg"):
            mean = np.mean([getattr(row, field) for row in rows])
            assert mean == pytest.approx(getattr(whole, field), abs=1.01e-4)
        assert np.mean([row.success_rate for row in rows]) == pytest.approx(whole.success_rate, abs=1e-4)


def test_order_of_the_worst_and_why() -> None:
    wrong = replace(query(1, 0.6), keyframe_in_reach=True, nearest_keyframe_m=0.1, nearest_keyframe_deg=3.0)
    assert explain(wrong) == "a wrong pose was trusted (10 inliers)"
    lost = replace(query(2, None, Verdict.FAILED), keyframe_in_reach=False, nearest_keyframe_m=0.8,
                   nearest_keyframe_deg=31.2, sharpness=20.0)  # fmt: skip
    assert explain(lost, 100.0) == (
        "the map does not know the place well: the nearest keyframe is 0.80 m and 31° away; too little agreed "
        "(20 inliers); the image is blurred: sharpness 20% of the usual"
    )
    missed = replace(wrong, retrieves=True, retrieval_rank=None)
    assert explain(missed).startswith("retrieval missed: no keyframe within 0.3 m and 20°")
    assert explain(replace(wrong, translation_m=0.04, rotation_deg=0.8)) == (
        "right, but among the largest errors; the nearest keyframe is 0.10 m and 3° away"
    )
    late = replace(wrong, retrieves=True, retrieval_rank=7)
    assert explain(late).startswith("the right keyframe was number 7 in the ranking, but only 3 were matched")
    edges = np.zeros((40, 40, 3), np.uint8)
    edges[:, 20:] = 255
    assert sharpness(cv2.GaussianBlur(edges, (0, 0), 3)) < 0.1 * sharpness(edges)
