"""Text and numbers from outside where people see them: names are never code, and numbers lose no digit.

Names of classes, recordings, maps and files come from other people's data. A terminal obeys escape sequences, a page
obeys tags, matplotlib reads mathematics between dollar signs. So every place where text is shown puts it through the
one function for that place. What is stored, and what JSON and CSV hold, stays as it is.
"""

from __future__ import annotations

import functools
import html
import math
import re
import shlex
import unicodedata
from collections.abc import Iterable
from decimal import Decimal
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # commands that show no camera do without arrays
    from semdb.types import Camera

DIGITS = 15  # that every float of eight bytes holds
_MARKDOWN = re.compile(r"[\\`*\[\]<>|~$&]|(?<![^\W_])_|_(?![^\W_])")


def for_terminal(text: object) -> str:
    r"""`text` as part of one line of a terminal or a log: what is not printable is written as Python writes it.

    Control characters, newlines, marks that change the direction of writing, and bytes of a file name that are no
    UTF-8 become ``\x1b``, ``\n``, ``\u202e``, ``\udcff``. Printable text, a backslash among it, stays as it is,
    so doing it twice changes nothing.
    """
    plain = str(text)
    if plain.isprintable():
        return plain
    return "".join(character if character.isprintable() else _escaped(character) for character in plain)


def for_html(text: object) -> str:
    """`text` as text, or a quoted attribute, of a page; what a page must not hold is written as for a terminal."""
    return html.escape(for_terminal(text))


def for_plot(text: object, most: int | None = None) -> str:
    r"""`text` as matplotlib is to get it: no dollar sign begins mathematics, a newline begins no line.

    Characters that matplotlib's own font lacks are written as ``\u53a8``, since it would draw the same box for each.
    What has more than `most` characters then lacks its middle.
    """
    plain = for_terminal(text)
    if not plain.isascii():
        glyphs = _glyphs()
        plain = "".join(c if ord(c) in glyphs else _escaped(c) for c in plain)
    if most is not None and len(plain) > most:
        half = max((most - 1) // 2, 1)
        plain = f"{plain[:half]}…{plain[-half:]}"
    return plain.replace("$", r"\$")


def for_legend(text: object, most: int | None = None) -> str:
    """As `for_plot`, for a label: matplotlib leaves those that begin with an underscore out of legends."""
    plain = for_plot(text, most)
    return f"\u200b{plain}" if plain.startswith("_") else plain  # a space without width


def for_json(document: str, *, ascii_only: bool = False) -> str:
    r"""A JSON document with what no terminal should get, or UTF-8 cannot hold, as JSON's own ``\uXXXX``: it means the
    same. Newlines between its values stay. `ascii_only` is for terminals that show no more.
    """
    if document.isascii():  # JSON escapes ASCII's control characters itself, but for DEL
        return document.replace("\x7f", "\\u007f")
    if ascii_only:
        return "".join(c if c == "\n" or " " <= c <= "~" else _utf16(c) for c in document)
    return "".join(c if c == "\n" or c.isprintable() else _utf16(c) for c in document)


def for_markdown(text: object) -> str:
    """`text` as a cell of a table in Markdown; an underscore within a word is none of its marks."""
    return _MARKDOWN.sub(r"\\\g<0>", for_terminal(text))


def for_shell(words: Iterable[str]) -> str:
    r"""A command to copy from a terminal: words are quoted where a shell needs it, ``$'\x1b'`` for what is no text."""
    return " ".join(shlex.quote(word) if word.isprintable() else _ansi_quoted(word) for word in words)


def number(value: float | Decimal) -> str:
    """A number for people: whole up to 15 digits, as short as that allows; ``nan``, ``inf`` and ``-inf``.

    Whole numbers and decimals of a database are printed with all their digits.
    """
    if isinstance(value, Decimal):
        if not value.is_finite():
            return str(value).lower()
        text = f"{value:f}"
        return (text.rstrip("0").rstrip(".") if "." in text else text) or "0"
    if isinstance(value, int):
        return str(value)
    value = float(value)
    if math.isfinite(value) and value.is_integer() and abs(value) < 2**53:
        return str(int(value))  # "-0" is 0 for people
    text = f"{value:.{DIGITS}g}"
    return repr(value) if math.isinf(float(text)) and math.isfinite(value) else text  # the largest, rounded up


def camera_numbers(camera: Camera) -> str:
    """Intrinsics, and coefficients of the lens where there are any, as ``--camera`` takes them."""
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    return ",".join(number(value) for value in numbers)


def measure(value: float, decimals: int, *, unless: tuple[float, ...] = (0.0,)) -> str:
    """A measured value with so many decimals, and with up to five more where it would read as a value that it is not.

    Those are `unless`: 0.00 metres of a way that was made, 100.0 % of queries of which one failed.
    """
    for digits in range(decimals, decimals + 6):
        text = f"{value:.{digits}f}"
        if not any(float(text) == mark != value for mark in unless):
            return text
    return f"{value:.{decimals}f}"


def width(text: str) -> int:
    """Columns of a terminal that `text`, which is printable, takes: two for characters of East Asia, none for marks."""
    if text.isascii():
        return len(text)
    return sum(
        0 if unicodedata.category(c) in ("Mn", "Me") else 2 if unicodedata.east_asian_width(c) in "WF" else 1
        for c in text
    )


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()


def _utf16(character: str) -> str:
    units = character.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[i]:02x}{units[i + 1]:02x}" for i in range(0, len(units), 2))


def _ansi_quoted(word: str) -> str:
    """Bash's, zsh's and POSIX' (2024) ``$'...'``, byte by byte where it is not ASCII."""
    plain = {ord("'"): "\\'", ord("\\"): "\\\\"}
    try:
        written = word.encode("utf-8", "surrogateescape")  # the bytes of a file name, as Python reads it
    except UnicodeEncodeError:
        written = word.encode("utf-8", "surrogatepass")
    return "$'" + "".join(plain.get(b, chr(b) if 32 <= b < 127 else f"\\x{b:02x}") for b in written) + "'"


@functools.cache
def _glyphs() -> frozenset[int]:
    """Code points that matplotlib's font for everything has, upright and bold."""
    from matplotlib import font_manager as fonts

    found = [fonts.findfont(fonts.FontProperties(family="DejaVu Sans", weight=weight)) for weight in ("normal", "bold")]
    regular, bold = (frozenset(fonts.get_font(file).get_charmap()) for file in found)
    return regular & bold
