"""Statements in a text: where one ends, whether it is finished; and what is said of their columns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from semdb.cli.output import distinct
from semdb.cli.progress import say


def _pieces(plain: str, escaped: str) -> re.Pattern[str]:
    """What may hold a semicolon that ends nothing: comments and quoted text. What is open goes on to the end."""
    quoted = "|".join(f"{q}(?:[^{q}{plain}]|{escaped}{q}{q})*(?:{q}|\\Z)" for q in ("'", '"'))
    return re.compile(
        rf"(?P<comment>--[^\n]*|\#[^\n]*|/\*.*?(?:\*/|\Z))|{quoted}|`[^`]*(?:`|\Z)|(?P<end>;)|[^;'\"`\#/-]+|.",
        re.DOTALL,
    )


_SERVER = _pieces(r"\\", r"\\.|")
_FILE = _pieces("", "")


@dataclass(frozen=True, slots=True)
class Statement:
    """`line` is that of its first word, from 1; `ended` says whether a semicolon stood behind it."""

    text: str
    line: int
    ended: bool


def statements(text: str, *, backslashes: bool) -> list[Statement]:
    """The statements of a text, without those that are blank or nothing but comments.

    With `backslashes` one in quoted text hides the character behind it, as on servers and not on SQLite.
    """
    found: list[Statement] = []
    pieces: list[str] = []
    line, first_line, words = 1, 0, False

    def finish(ended: bool) -> None:
        if words:
            found.append(Statement("".join(pieces).strip(), first_line, ended))

    for match in (_SERVER if backslashes else _FILE).finditer(text):
        piece = match[0]
        if match["end"]:
            finish(ended=True)
            pieces, words = [], False
        else:
            pieces.append(piece)
            if not words and not match["comment"] and piece.strip():
                words, first_line = True, line + piece[: len(piece) - len(piece.lstrip())].count("\n")
        line += piece.count("\n")
    finish(ended=False)
    return found


def say_renamed(columns: Sequence[str], fmt: str) -> None:
    """Says which names columns go by in JSON, where several have the same."""
    if fmt == "json" and distinct(columns) != list(columns):
        say(f"columns of equal names are numbered: {', '.join(distinct(columns))}")
