"""Text from outside is no code where it is shown, and numbers lose no digit: properties of the escaping functions."""

from __future__ import annotations

import csv
import io
import itertools
import json
import logging
import math
import subprocess
import unicodedata
import warnings
from decimal import Decimal
from html.parser import HTMLParser

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from semdb.cli.output import distinct, print_csv, print_json, print_rows, print_table
from semdb.cli.progress import Progress, StagedProgress, say
from semdb.events import JsonFormatter, PlainFormatter, event
from semdb.jsonable import to_jsonable
from semdb.shown import (
    for_html,
    for_json,
    for_legend,
    for_markdown,
    for_plot,
    for_shell,
    for_terminal,
    measure,
    number,
    width,
)

# What is code somewhere: escape sequences, marks of direction, markup of pages, terminals, mathematics and Markdown.
CODE = [
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "\x9b2J", "a\nb\r\tc\x0b\x0c\x85\u2028\u2029", "\x00", "\x7f\x80",
    "\u202egnp.exe", "\u2066a\u2069", "\u200d\u200b\ufeff", "\udce9\ud800", "\U000e0041", "$\\frac{x$", "$a$ \\$b$",
    "\\$", "$", "$$", "\\", "[red]x[/red]", "[/]", "[link=file:///]", ":smile:", "<script>alert(1)</script>",
    "\"'&amp;<",
    "`x` *a* _b_ c_d | ~~e~~ ![i](u) <u>", "%s %(x)d {0} {x}", "厨房 Küche", "🍽", "e\u0301\u20dd", "_hidden",
]  # fmt: skip
ANY = st.text(st.characters()) | st.sampled_from(CODE) | st.lists(st.sampled_from(CODE)).map("".join)


@settings(deadline=None)
@given(ANY)
def test_a_line_of_a_terminal_is_printable_and_printable_text_is_itself(text: str) -> None:
    shown = for_terminal(text)
    assert shown.isprintable()
    assert for_terminal(shown) == shown
    shown.encode()
    printable = "".join(c for c in text if c.isprintable())
    assert for_terminal(printable) == printable
    assert (shown == text) == text.isprintable()


def test_escapes_are_those_of_python() -> None:
    assert for_terminal("a\x1b[31m\n\u202e\udce9\U000e0041\\ ü") == r"a\x1b[31m\n\u202e\udce9\U000e0041\ ü"
    assert for_terminal(ValueError("bell\x07")) == r"bell\x07"


class _Page(HTMLParser):
    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, list[tuple[str, str | None]]]] = []
        self.texts: list[str] = []
        self.feed(page)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, attrs))

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


@settings(deadline=None)
@given(ANY)
def test_a_page_shows_text_as_text(text: str) -> None:
    page = _Page(f'<p title="{for_html(text)}">{for_html(text)}</p>')
    assert page.tags == [("p", [("title", for_terminal(text))])]
    assert "".join(page.texts) == for_terminal(text)


@settings(deadline=None)
@given(ANY)
def test_matplotlib_reads_no_mathematics(text: str) -> None:
    from matplotlib.text import Text

    drawn, mathematics = Text()._preprocess_math(for_plot(text))  # type: ignore[attr-defined]
    assert mathematics is False
    assert drawn.isprintable()
    if text.isascii():
        assert drawn == for_terminal(text)
    assert not for_legend(f"_{text}").startswith("_")
    assert for_legend(text).removeprefix("\u200b") == for_plot(text)


def test_what_the_font_of_plots_lacks_is_told_apart() -> None:
    assert for_plot("厨房 Küche") == r"\u53a8\u623f Küche"


@settings(max_examples=25, deadline=None)
@given(ANY.filter(bool))
def test_matplotlib_draws_any_text_without_a_word(text: str) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3, 1))
    axes = figure.subplots()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        axes.set_title(for_plot(text))
        axes.text(0, 0, for_plot(text), weight="bold")
        axes.plot([0, 1], label=for_legend(text))
        legend = axes.legend()
        FigureCanvasAgg(figure).draw()
    assert len(legend.get_texts()) == 1


def _no_pairs(text: str) -> bool:
    """Two halves of a character side by side are that character to JSON."""
    return not any("\ud800" <= a < "\udc00" <= b <= "\udfff" for a, b in itertools.pairwise(text))


@settings(deadline=None)
@given(st.recursive(ANY.filter(_no_pairs) | st.integers() | st.none(), lambda x: st.lists(x) | st.dictionaries(ANY, x)))
def test_json_means_the_same_and_is_safe_to_show(value: object) -> None:
    stream = io.StringIO()
    print_json(value, stream)
    text = stream.getvalue()
    assert all(c == "\n" or c.isprintable() for c in text)
    assert text.encode()
    assert json.loads(text) == json.loads(json.dumps(value))
    assert for_json(text) == text


@settings(deadline=None)
@given(ANY)
def test_markdown_shows_text_as_text(text: str) -> None:
    from markdown_it import MarkdownIt

    shown = for_terminal(text).strip()
    page = _Page(MarkdownIt("commonmark").enable("table").render(f"| a |\n|---|\n| {for_markdown(shown)} |\n| b |\n"))
    assert [tag for tag, _ in page.tags] == ["table", "thead", "tr", "th", "tbody", "tr", "td", "tr", "td"]
    cell = [line for line in "".join(page.texts).split("\n") if line][1:-1]
    assert cell == ([shown] if shown else [])


def _is_argument(text: str) -> bool:
    """Whether a process can be given `text`: no NUL, and of halves of characters only what stands for a byte."""
    return not any(c == "\0" or "\ud800" <= c < "\udc80" or "\udd00" <= c <= "\udfff" for c in text)


@settings(max_examples=40, deadline=None)
@given(st.lists(ANY.filter(_is_argument)))
@example(["\udce9\udcff", "a b", "", "it's", "-\n'\\"])
def test_a_shell_reads_the_words_that_were_meant(words: list[str]) -> None:
    command = for_shell(words)
    assert command.isprintable()
    done = subprocess.run(["bash", "-c", f"printf '%s\\0' {command}"], capture_output=True, check=True)
    expected = b"".join(word.encode("utf-8", "surrogateescape") + b"\0" for word in words)
    assert done.stdout == (expected or b"\0")


@settings(deadline=None)
@given(st.integers(-(10**15) + 1, 10**15 - 1), st.integers(0, 8))
def test_fifteen_digits_are_printed_whole(digits: int, decimals: int) -> None:
    exact = Decimal(digits).scaleb(-decimals)
    assert Decimal(number(float(exact))) == exact
    assert Decimal(number(exact)) == exact
    assert "e" not in number(exact)


@settings(deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_is_as_near_as_fifteen_digits_are(value: float) -> None:
    assert float(number(value)) == pytest.approx(value, rel=6e-15, abs=0)
    if value.is_integer() and abs(value) < 2**53:
        assert number(value) == str(int(value))


def test_numbers() -> None:
    assert number(1305031251.1297312) == "1305031251.12973"
    assert [number(x) for x in (5348996.123456, 0.1 + 0.2, 517.306408, 5000.0, 1e300)] == [
        "5348996.123456", "0.3", "517.306408", "5000", "1e+300",
    ]  # fmt: skip
    assert [number(x) for x in (math.nan, math.inf, -math.inf, -0.0, 2**80)] == ["nan", "inf", "-inf", "0", str(2**80)]
    assert number(Decimal("123456789012345678901234567890.1234567890")) == "123456789012345678901234567890.123456789"
    assert [number(Decimal(x)) for x in ("2.50", "0E+3", "1E+3", "0.000", "NaN")] == ["2.5", "0", "1000", "0", "nan"]


@settings(deadline=None)
@given(st.floats(0, 1e6), st.integers(0, 4))
def test_a_measure_never_reads_as_zero_or_all_when_it_is_not(value: float, decimals: int) -> None:
    text = measure(value, decimals, unless=(0.0, 100.0))
    if value > 2e-9 and abs(value - 100) > 1e-6:
        assert float(text) not in (0.0, 100.0) or decimals < 4
    assert abs(float(text) - value) <= 0.51 * 10**-decimals


def test_measures() -> None:
    assert [measure(x, 2) for x in (0.0, 1.744, 0.004, 0.0000004)] == ["0.00", "1.74", "0.004", "0.0000004"]
    assert [measure(x, 1, unless=(0.0, 100.0)) for x in (100.0, 99.96, 99.94)] == ["100.0", "99.96", "99.9"]


@settings(deadline=None)
@given(st.lists(st.sampled_from(["id", "id_2", "id_3", "name", "", "a\nb"]) | ANY, max_size=8))
def test_keys_of_columns_are_distinct_and_names_that_occur_once_stay(columns: list[str]) -> None:
    keys = distinct(columns)
    assert len(set(keys)) == len(columns)
    for column, key in zip(columns, keys, strict=True):
        assert key == column or key.startswith(f"{column}_")
        if columns.count(column) == 1:
            assert key == column
        assert keys[columns.index(column)] == column


def test_equal_columns_lose_no_value_in_json() -> None:
    stream = io.StringIO()
    print_rows(("name", "name", "id", "id", "id_2", "id"), [("room", "first", 7, 3, 4, 5)], "json", stream)
    assert json.loads(stream.getvalue()) == [
        {"name": "room", "name_2": "first", "id": 7, "id_3": 3, "id_2": 4, "id_4": 5}
    ]


def test_decimals_and_times_of_servers_keep_their_digits() -> None:
    from datetime import timedelta

    long = Decimal("1305031251.12973123456789")
    row = (
        long,
        Decimal("0.30"),
        Decimal("7.000"),
        Decimal("123456789012345678901"),
        timedelta(hours=-26, seconds=-4.5),
    )
    assert to_jsonable(row) == ["1305031251.12973123456789", 0.3, 7, 123456789012345678901, "-26:00:04.5"]
    stream = io.StringIO()
    print_csv("abcde", [row], stream)
    assert stream.getvalue().splitlines()[1] == "1305031251.12973123456789,0.3,7,123456789012345678901,-26:00:04.5"
    stream = io.StringIO()
    print_table("abcde", [row], stream)
    assert stream.getvalue().splitlines()[2].split() == [
        "1305031251.12973123456789", "0.3", "7", "123456789012345678901", "-26:00:04.5",
    ]  # fmt: skip
    stream = io.StringIO()
    print_table("ab", [(math.inf, -math.inf)], stream)
    assert stream.getvalue().splitlines()[2].split() == ["inf", "-inf"]


@settings(deadline=None)
@given(st.lists(st.tuples(ANY, ANY), min_size=1, max_size=4), ANY, ANY)
def test_a_table_is_one_line_a_row_and_its_columns_stand_below_each_other(
    rows: list[tuple[str, str]], first: str, second: str
) -> None:
    stream = io.StringIO()
    print_table((first, second), rows, stream)
    lines = stream.getvalue().split("\n")
    assert len(lines) == len(rows) + 3
    assert all(line.isprintable() for line in lines)
    wide = max(width(for_terminal(text)) for text in (first, *(row[0] for row in rows)))
    for row, line in zip(rows, lines[2:], strict=False):
        left = for_terminal(row[0])
        assert line == (left + " " * (wide - width(left)) + "  " + for_terminal(row[1])).rstrip()


def test_wide_characters_take_two_columns() -> None:
    assert [width(text) for text in ("abc", "厨房", "e\u0301", "\uff46", "Küche")] == [3, 4, 1, 2, 5]
    assert unicodedata.name("厨") == "CJK UNIFIED IDEOGRAPH-53A8"


@settings(deadline=None)
@given(st.lists(st.tuples(ANY, ANY), max_size=3))
def test_csv_is_what_is_stored_and_on_a_terminal_it_is_safe(rows: list[tuple[str, str]]) -> None:
    rows = [tuple(text.replace("\r", "") for text in row) for row in rows]  # type: ignore[misc]
    stream = io.StringIO(newline="")
    print_csv(("a", "b\x1b"), rows, stream)
    assert list(csv.reader(io.StringIO(stream.getvalue(), newline=""))) == [["a", "b\x1b"], *map(list, rows)]
    terminal = io.StringIO()
    terminal.isatty = lambda: True  # type: ignore[method-assign]
    print_csv(("a", "b\x1b"), rows, terminal)
    assert all(line.isprintable() for line in terminal.getvalue().split("\n"))


@settings(deadline=None)
@given(ANY, ANY)
def test_an_event_is_one_line_as_text_and_as_json(name: str, why: str) -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    logger = logging.getLogger("semdb")
    before = (logger.handlers, logger.level, logger.propagate)
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.INFO)
    try:
        for formatter in (logging.Formatter("%(message)s"), PlainFormatter(), JsonFormatter()):
            handler.setFormatter(formatter)
            event("failed", recording=name, error=why, seconds=math.nan)
        text, plain, line, end = stream.getvalue().split("\n")
    finally:
        logger.handlers, logger.propagate = before[0], before[2]
        logger.setLevel(before[1])
    assert end == ""
    assert text == plain == f"failed recording={for_terminal(name)} error={for_terminal(why)} seconds=nan"
    assert line.isascii()
    assert json.loads(line)["error"] == json.loads(json.dumps(why))
    assert json.loads(line)["seconds"] is None


def test_tracebacks_in_logs_hold_no_escape_sequences() -> None:
    record = logging.LogRecord("celery", logging.ERROR, "f.py", 1, "task %s raised", ("\x1b[31m\n",), None)
    try:
        raise ValueError("\x1b[2J\nforged line")
    except ValueError as error:
        record.exc_info = (ValueError, error, error.__traceback__)
    text = PlainFormatter(logging.Formatter("%(levelname)s %(message)s")).format(record)
    lines = text.split("\n")
    assert lines[0] == r"ERROR task \x1b[31m\n raised"
    assert lines[-1] == "forged line"
    assert lines[-2] == r"ValueError: \x1b[2J"
    assert all(line.isprintable() for line in lines)


@pytest.mark.parametrize("name", CODE)
def test_progress_and_lines_for_people(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    say(f"{name}: done")
    assert capsys.readouterr().err == f"semdb: {for_terminal(name)}: done\n"
    stream = io.StringIO()
    with Progress(f"ingesting {name}", stream=stream, terminal=True) as progress:
        progress.update(1, 2)
        cells = [column(progress._bar.tasks[0]) for column in progress._bar.columns[:1]]
    assert [cell.plain for cell in cells] == [f"ingesting {for_terminal(name)}"]
    assert all(not cell.spans for cell in cells)
    stream = io.StringIO()
    with Progress(name, stream=stream, terminal=False) as progress:
        progress.printed -= 10
        progress.update(1, 2)
    assert stream.getvalue().startswith(f"{for_terminal(name)}: 1 of 2 frames")
    assert stream.getvalue().count("\n") == 1
    with StagedProgress() as staged:
        staged.update(name, 1, 2)
        assert staged._current is not None
        assert staged._current.label == for_terminal(name)
