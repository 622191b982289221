"""Tables, plots and the report of an evaluation."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from semdb.errors import UsageError
from semdb.evaluation.metrics import EvaluationResult, QueryResult, summarise
from semdb.evaluation.plots import (
    SERIES,
    cumulative_plot,
    cumulative_shares,
    figure_png,
    inlier_plot,
    series_names,
    trajectory_plot,
)
from semdb.evaluation.report import worst_queries, write_report
from semdb.evaluation.tables import (
    HEADERS,
    PAPER_TABLE_3,
    by_keyframes,
    paper_markdown,
    paper_table,
    result_row,
    results_markdown,
    results_table,
)
from semdb.geometry import pose_from, so3_exp
from semdb.types import ModelInfo, Verdict


def query(index: int, metres: float | None, verdict: Verdict = Verdict.LOCALIZED, reason: str = "") -> QueryResult:
    truth = pose_from(so3_exp([0, 0.05 * index, 0]), [0.1 * index, 0.0, np.sin(index)])
    degrees = None if metres is None else 20 * metres
    return QueryResult(
        f"rgb/{index}.png", index, verdict, metres, degrees, 3, 10 * index, 0.9, "filtered", 0.25, 3,
        {"match": 5.0, "total": 40.0}, reason, None, truth,
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
    left, right = figure.axes
    assert (left.get_xlim(), right.get_xlim()) == ((0, 0.5), (0, 10))
    curve = left.get_lines()[0]
    x, y = np.asarray(curve.get_xdata(), float), np.asarray(curve.get_ydata(), float)
    assert (x[0], x[-1]) == (0.0, 0.5)
    assert y[np.searchsorted(x, 0.045)] == pytest.approx(0.4)  # 1 to 4 cm of ten queries
    assert y[-1] == pytest.approx(0.7)  # neither 0.6 m, nor the ambiguous, nor the failed one
    turned = right.get_lines()[0]
    assert np.asarray(turned.get_ydata(), float)[-1] == pytest.approx(0.7)
    marks = [line.get_xydata().tolist() for line in (*left.get_lines(), *right.get_lines()) if line.get_marker() == "D"]
    assert marks == [[[0.3, 0.9]], [[2.5, 0.8]]]
    assert [text.get_text() for text in left.get_legend().get_texts()] == ["semdb, 25 keyframes", "cnn, 25 keyframes"]


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
        paper_table(three),
    ):
        text = printed(renderable)
        assert max(len(line.rstrip()) for line in text.splitlines()) <= 80
        assert "0.0450 / 0.90" in text
        assert "…" not in text


def test_order_by_number_of_keyframes() -> None:
    ordered = by_keyframes([result(keyframes=50), result("cnn", 12), result(keyframes=12)])
    assert [(item.method, item.keyframes) for item in ordered] == [("cnn", 12), ("semdb", 12), ("semdb", 50)]


def test_figures_of_the_paper() -> None:
    sequences = [row for row in PAPER_TABLE_3 if row.keyframes is not None]
    assert len(sequences) == 14
    office = next(row for row in sequences if row.sequence.endswith("office room kt1"))
    assert (office.keyframes, office.test_frames, office.success_rate) == (47, 600, 0.7794)
    text = paper_markdown([result()])
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
    results = [result(keyframes=50), result(keyframes=12), result(recording="desk")]
    results[0] = replace(results[0], models=(ModelInfo("features", "sift", ""),))
    steps: list[tuple[int, int]] = []
    page = write_report(
        tmp_path / "new" / "report", results, settings={"SEMDB_FEATURES": "surf <x>"},
        picture_of=lambda _, q: figure_png(inlier_plot(EMPTY)) if q.frame_index == 8 else None,
        progress=lambda done, total: steps.append((done, total)),
    )  # fmt: skip
    folder = page.parent
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(
        ["index.html", "results.json", "queries.csv", "errors-1.png", "errors-2.png"]
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
    assert len(images) == 2 + 2 * 3 + 3
    assert all(str(image["src"]).startswith("data:image/png;base64,") for image in images)
    assert not any(tag in ("script", "link", "a", "iframe") for tag, _ in parser.seen)
    assert "surf &lt;x&gt;" in text
    assert "<dt>features</dt><dd>surf abababababab, sift</dd>" in text
    assert "&lt;b&gt;two places&lt;/b&gt;" in text
    assert "<b>" not in text


def test_report_of_an_empty_result(tmp_path: Path) -> None:
    page = write_report(tmp_path, [EMPTY])
    assert json.loads((tmp_path / "results.json").read_text())["success_rate"] is None
    assert "none, 9 keyframes" in page.read_text(encoding="utf-8")


def test_report_errors_say_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="at least one result"):
        write_report(tmp_path, [])
    (tmp_path / "file").write_text("")
    with pytest.raises(UsageError, match=r"cannot be written to .*file"):
        write_report(tmp_path / "file", [EMPTY])
