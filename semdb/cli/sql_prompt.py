"""`semdb sql` on a terminal: a prompt with history, and TAB for tables, columns and words of SQL."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import textwrap
import time
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

from semdb.cli.output import print_lines, print_rows
from semdb.cli.sql_text import Statement, say_renamed, statements
from semdb.errors import SemdbError, UsageError

if TYPE_CHECKING:
    from semdb.api import Database

MOST_ROWS = 1000  # that a prompt prints
HISTORY_LINES = 2000
FIRST, NEXT = "semdb> ", "  ...> "
FORMATS = ("table", "csv", "json")
WORDS = (
    "SELECT DISTINCT FROM WHERE AND OR NOT IN IS NULL LIKE BETWEEN EXISTS JOIN LEFT ON GROUP BY HAVING ORDER ASC DESC "
    "LIMIT AS CASE WHEN THEN ELSE END UNION WITH COUNT( SUM( AVG( MIN( MAX( ROUND( COALESCE("
)
HELP = """\
One statement that reads, on one line or several: a semicolon or an empty line ends it. TAB completes.
  \\d          tables and views        \\d NAME     columns of one
  \\f FORMAT   table, csv or json      \\q          leave (so do quit, exit and Ctrl-D)
docs/sql.md has questions to start from."""


class Prompt:
    """Reads statements and prints what they give until there are no more."""

    def __init__(self, database: Database, fmt: str, known: Mapping[str, tuple[str, ...]]) -> None:
        """`known` are the tables and views with their columns."""
        self.database = database
        self.fmt = fmt
        self.known = known

    def run(self) -> None:
        """The prompt, until the end of input. Errors of statements are told and the prompt goes on."""
        with _line_editing(self):
            while True:
                try:
                    text = self._read()
                except EOFError:
                    print_lines("")
                    return
                except KeyboardInterrupt:
                    print_lines("")
                    continue
                if text.strip().lower().rstrip(";").strip() in ("\\q", "quit", "exit"):
                    return
                with _told():
                    self._answer(text)

    def _read(self) -> str:
        """One statement, or a line that begins with a backslash. Raises EOFError."""
        lines = [input(FIRST)]
        if lines[0].lstrip().startswith(("\\", "?")) or lines[0].strip().lower() in ("quit", "exit", "help"):
            return lines[0]
        while lines[-1].strip():
            found = self._statements("\n".join(lines))
            if found and found[-1].ended:
                break
            try:
                lines.append(input(NEXT))
            except EOFError:
                print_lines("")
                break
        return "\n".join(lines)

    def _statements(self, text: str) -> list[Statement]:
        return statements(text, backslashes=not self.database.settings.database_url.startswith("sqlite"))

    def _answer(self, text: str) -> None:
        command, _, argument = text.strip().partition(" ")
        if command in ("?", "help", "\\?", "\\h"):
            print_lines(*HELP.splitlines())
        elif command == "\\d":
            self._describe(argument.strip(" ;"))
        elif command == "\\f":
            self._set_format(argument.strip())
        elif command.startswith("\\"):
            raise UsageError(f"{command} is no command here: \\d, \\f, \\q, or ? for help")
        else:
            for statement in self._statements(text):
                self._query(statement.text)

    def _query(self, statement: str) -> None:
        began = time.monotonic()
        with self.database.sql(statement) as rows:
            columns = rows.columns
            shown = list(islice(rows, MOST_ROWS))
            more = next(iter(rows), None) is not None
        seconds = time.monotonic() - began
        say_renamed(columns, self.fmt)
        print_rows(columns, shown, self.fmt)
        count = f"{len(shown)} row{'' if len(shown) == 1 else 's'}"
        if more:
            count = f"the first {MOST_ROWS} rows of more: narrow it, or semdb sql --file prints all"
        print_lines(f"({count}, {seconds:.2f} s)")

    def _describe(self, name: str) -> None:
        if not name:
            widest = max(map(len, self.known), default=0)
            for table, columns in self.known.items():
                print_lines(*_beside(table.ljust(widest), ", ".join(columns)))
        elif name in self.known:
            print_lines(*self.known[name])
        else:
            raise UsageError(f"there is no table or view {name!r}: \\d lists them")

    def _set_format(self, name: str) -> None:
        if name not in FORMATS:
            raise UsageError(f"\\f {name}: known are {', '.join(FORMATS)}")
        self.fmt = name


def completions(known: Mapping[str, tuple[str, ...]], line: str, word: str) -> list[str]:
    """What fits for `word` at the end of `line` (which has it): tables behind FROM, else columns, words and tables."""
    table, dot, start = word.rpartition(".")
    if dot:
        columns = known.get(_aliases(line).get(table, table), ())
        return [f"{table}.{column}" for column in columns if column.startswith(start)]
    before = line[: len(line) - len(word)]
    if re.search(r"(?:\b(?:FROM|JOIN)\s+|\\d\s+)$", before, re.IGNORECASE):
        return [name for name in known if name.startswith(word)]
    named = [name for name in known if re.search(rf"\b{re.escape(name)}\b", before)]
    fitting = sorted({column for name in named or known for column in known[name] if column.startswith(word)})
    if word:
        words = [each for each in WORDS.split() if each.startswith(word.upper())]
        fitting += [each.lower() for each in words] if word.islower() else words
        fitting += [name for name in known if name.startswith(word)]
    return fitting


def _aliases(line: str) -> dict[str, str]:
    """Table by the name that a statement gives it: ``keyframes k``, ``objects AS o``."""
    pairs = re.findall(r"\b(?:FROM|JOIN|,)\s+(\w+)\s+(?:AS\s+)?(\w+)", line, re.IGNORECASE)
    return {alias: table for table, alias in pairs}


def _beside(name: str, text: str) -> list[str]:
    """`text` behind `name`, broken to the width of the terminal."""
    indent = " " * (len(name) + 2)
    width = max(40, shutil.get_terminal_size().columns)
    return textwrap.wrap(f"{name}  {text}", width, subsequent_indent=indent, break_long_words=False)


@contextlib.contextmanager
def _told() -> Iterator[None]:
    """An error, or Ctrl-C, ends a statement and not the prompt."""
    try:
        yield
    except SemdbError as error:
        print_lines(f"semdb: {error}")
    except KeyboardInterrupt:
        print_lines("semdb: interrupted")


@contextlib.contextmanager
def _line_editing(prompt: Prompt) -> Iterator[None]:
    """History and TAB within, where Python was built with readline."""
    try:
        import readline
    except ImportError:
        yield
        return

    def complete(_word: str, state: int) -> str | None:
        if state == 0:
            line = readline.get_line_buffer()[: readline.get_endidx()]
            matches[:] = completions(prompt.known, line, line[readline.get_begidx() :])
        return matches[state] if state < len(matches) else None

    matches: list[str] = []
    readline.set_completer(complete)
    readline.set_completer_delims(" \t\n,()=<>+-*/|'\"`;")
    libedit = "libedit" in (readline.__doc__ or "")
    readline.parse_and_bind("bind ^I rl_complete" if libedit else "tab: complete")
    file = history_file()
    with contextlib.suppress(OSError):
        readline.read_history_file(file)
    try:
        yield
    finally:
        readline.set_completer(None)
        readline.set_history_length(HISTORY_LINES)
        with contextlib.suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            readline.write_history_file(file)
            file.chmod(0o600)  # statements may hold what is nobody else's business


def history_file() -> Path:
    """Where the prompt keeps what was typed: ``sql_history`` in the user's folder for such files."""
    state = os.environ.get("XDG_STATE_HOME")
    return (Path(state) if state else Path.home() / ".local" / "state") / "semdb" / "sql_history"
