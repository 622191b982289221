"""What can be told of a statement for a server without asking it: whether it reads, and what it would lift or lock.

Nothing here is what keeps a database from being changed (`semdb.database.readonly`). It refuses what an account that
may only read may do all the same: locks that make writers wait, and hints that lift limits.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterator

from semdb.errors import UsageError

FIRST_WORDS = ("SELECT", "WITH", "EXPLAIN", "VALUES", "SHOW", "DESCRIBE", "DESC", "TABLE")
HIDDEN = ("access_tokens", "service_jobs")
"""Tables that nobody reads with a statement of his own."""
PRIVATE = {"recordings": "source", "ingest_items": "error", "queries": "image", "recording_findings": "message"}
"""Columns that may tell of files and folders, by table."""
_COMMENT = re.compile(r"\s+|--[^\n]*(?:\n|$)|#[^\n]*(?:\n|$)|/\*(?!M?!).*?\*/", re.DOTALL)
# In this order; the mode of our sessions knows escapes with a backslash, and no names in double quotes.
_TOKEN = re.compile(
    r"""
    (?P<hint>/\*\+.*?(?:\*/|$))
    | (?P<executed>/\*M?!)
    | (?P<comment>/\*.*?(?:\*/|$) | --(?=[\s\x00-\x1f]|$)[^\n]*(?:\n|$) | \#[^\n]*(?:\n|$))
    | (?P<quoted>'(?:[^'\\]|\\.|'')*(?:'|$) | "(?:[^"\\]|\\.|"")*(?:"|$) | `(?:[^`]|``)*(?:`|$))
    | (?P<word>[^\W\d][\w$]*)
    | (?P<other>\S)
    """,
    re.DOTALL | re.VERBOSE,
)
_LOCKS = (("FOR", "UPDATE"), ("FOR", "SHARE"), ("LOCK", "IN", "SHARE", "MODE"))
_LIFTED = re.compile(r"\b(MAX_EXECUTION_TIME|SET_VAR)\b", re.IGNORECASE)


def check_reads(sql: str) -> None:
    """A clear message for what is obviously no query; what holds is what the database enforces. Raises UsageError."""
    place = 0
    while (match := _COMMENT.match(sql, place)) is not None:
        place = match.end()
    word = re.match(r"[A-Za-z]+", sql[place:].lstrip("( \n\t"))
    if word is None or word.group().upper() not in FIRST_WORDS:
        shown = sql[place : place + 40]
        raise UsageError(f"only queries can be run here ({', '.join(FIRST_WORDS[:2])} ...), not {shown!r}")


def check_hidden(sql: str, *, private: bool = False) -> None:
    """Raises UsageError for a statement for a server that names a hidden table, in whatever quotes and letters.

    Without its name no SELECT reaches it: nothing in one makes names of texts. With `private` the tables with private
    columns may not be named either: which of their columns a statement reads cannot be told from here.
    """
    plain = unicodedata.normalize("NFKC", sql).casefold()
    for name in HIDDEN:
        if name in plain:
            raise UsageError(f"{name} is not shown here")
    for name in PRIVATE if private else ():
        if re.search(rf"(?<!\w){name}(?!\w)", plain):
            raise UsageError(f"{name} is not shown here, since it tells where files lie; views name recordings, too")


def check_limits(sql: str) -> None:
    """Raises UsageError for a statement of a server that locks what it reads, or has a hint that lifts its limits.

    Also for comments that a server executes or not by its version, since then it cannot be told.
    """
    found: list[str] = []
    for kind, text in _tokens(sql):
        if kind == "executed":
            raise UsageError(f"comments that are executed ({text} ... */) are not allowed here: write what is in them")
        if kind == "hint" and (lifted := _LIFTED.search(text)) is not None:
            raise UsageError(
                f"the hint {lifted[1].upper()} is not allowed here: SEMDB_SQL_TIME_LIMIT_S is the time limit"
            )
        found.append(text.upper() if kind == "word" else kind)
    for place in range(len(found)):
        for words in _LOCKS:
            if tuple(found[place : place + len(words)]) == words:
                raise UsageError(
                    f"{' '.join(words)} locks what it reads and makes writers wait: leave it out (a name of that kind "
                    "is written in backticks)"
                )


def _tokens(sql: str) -> Iterator[tuple[str, str]]:
    """What a statement is made of, comments left out."""
    for match in _TOKEN.finditer(sql):
        kind = match.lastgroup or ""
        if kind != "comment":
            yield kind, match.group()
