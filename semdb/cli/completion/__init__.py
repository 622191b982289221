"""What TAB offers in a shell: commands, options, values. Light, since every press of the key starts a process.

The script of the shell (`semdb.cli.completion.shells`) calls `semdb` with the line up to the cursor in the variable
`VARIABLE`; `answer` prints what could stand there.
"""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from semdb.cli.completion.values import of_argument, of_option
from semdb.shown import for_terminal

VARIABLE = "_SEMDB_COMPLETE"
BREAKS = "_SEMDB_BREAKS"  # characters that the shell divides words at, beside spaces
_HARMLESS = re.compile(r"[\w@%+=:,./ -]+")


@dataclass(frozen=True, slots=True)
class Line:
    """A command line up to the cursor: the words before, without that of the program, and the one under way."""

    words: tuple[str, ...]
    word: str
    quoted: bool  # the word under way begins with a quotation mark


@dataclass(frozen=True, slots=True)
class Offer:
    """`entries` are (value, what it is); with `files` names of files fit too."""

    entries: tuple[tuple[str, str], ...] = ()
    files: bool = False


def split_line(line: str) -> Line:
    """The words of a line as a shell divides them; a quotation mark that is still open is closed."""
    for closing in ("", "\\", "'", '"'):
        try:
            words = shlex.split(line + closing)
            break
        except ValueError:
            continue
    else:
        words = line.split()
    fresh = not line or (line[-1].isspace() and not closing and not line.endswith("\\ "))
    if fresh or not words:
        return Line(tuple(words[1:]), "", False)
    return Line(tuple(words[1:-1]), words[-1], closing in ("'", '"'))


def offer(root: Any, line: Line, environment: Mapping[str, str]) -> Offer:
    """What fits where the cursor is, in a command line of the click group `root`."""
    command, pending, positional, only_arguments = root, None, 0, False
    given: dict[str, str] = {}  # long options that were given, with their values
    for word in line.words:
        if pending is not None:
            given[_long(pending)], pending = word, None
        elif word == "--":
            only_arguments = True
        elif word.startswith("-") and word != "-" and not only_arguments:
            name, equals, value = word.partition("=")
            option = _options(command).get(name)
            if option is None:
                continue
            given[_long(option)] = value
            pending = option if _takes_value(option) and not equals else None
        elif hasattr(command, "list_commands"):
            command, given, positional = command.get_command(None, word), {}, 0
            if command is None:
                return Offer()
        else:
            positional += 1
    if pending is not None:
        return _matching(of_option(pending, given, environment), line.word)
    if line.word.startswith("-") and not only_arguments:
        name, equals, value = line.word.partition("=")
        if equals:
            option = _options(command).get(name)
            return Offer() if option is None else _matching(of_option(option, given, environment), value)
        return Offer(tuple(_option_entries(command, line.word, given)))
    if hasattr(command, "list_commands"):
        names = [name for name in command.list_commands(None) if name.startswith(line.word)]
        return Offer(tuple((name, _help(command.get_command(None, name))) for name in names))
    argument = _argument(command, positional)
    return Offer() if argument is None else _matching(of_argument(command, argument, given, environment), line.word)


def answer(root: Any) -> str:
    """What the script of the shell reads: ``files`` or ``plain``, then a line per value with what it is behind a tab.

    A value is what stands for the part of the word that the shell replaces: behind the last of the characters in
    `BREAKS`, and of an option with its value (``--map=room``) the value. In a line with a quotation mark bash puts it
    in as it is: there only names are offered that mean nothing to a shell.
    """
    typed = os.environ[VARIABLE]
    line = split_line(typed)
    found = offer(root, line, os.environ)
    cut = 0
    if not line.quoted and not line.word.startswith("-"):
        cut = 1 + max((line.word.rfind(sign) for sign in os.environ.get(BREAKS, "")), default=-1)
    lines = ["files" if found.files else "plain"]
    fit = _HARMLESS.fullmatch if "'" in typed or '"' in typed else str.isprintable
    lines += [f"{value[cut:]}\t{for_terminal(text)}" for value, text in found.entries if value[cut:] and fit(value)]
    return "\n".join(lines)


def _options(command: Any) -> dict[str, Any]:
    return {name: param for param in _params(command) for name in (*param.opts, *param.secondary_opts)}


def _params(command: Any) -> list[Any]:
    return [param for param in command.params if param.param_type_name == "option"]


def _long(option: Any) -> str:
    return str(max(option.opts, key=len))


def _takes_value(option: Any) -> bool:
    return not (option.is_flag or getattr(option, "count", False))


def _option_entries(command: Any, word: str, given: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    for option in _params(command):
        if getattr(option, "hidden", False) or (_long(option) in given and not option.multiple):
            continue
        for name in (*option.opts, *option.secondary_opts):
            if name.startswith(word) and (name.startswith("--") or word == name):
                yield name, _first_line(option.help or "")
    if "--help".startswith(word):
        yield "--help", "Show this message and exit."


def _argument(command: Any, position: int) -> Any:
    """The argument that the word at `position` is of; the last one where it takes any number."""
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    if position < len(arguments):
        return arguments[position]
    return arguments[-1] if arguments and arguments[-1].nargs == -1 else None


def _matching(candidates: tuple[Sequence[tuple[str, str]], bool], word: str) -> Offer:
    entries, files = candidates
    return Offer(tuple(entry for entry in entries if entry[0].startswith(word)), files)


def _help(command: Any) -> str:
    return _first_line(command.help or "")


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]
