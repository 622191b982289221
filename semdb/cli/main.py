"""The one entry point: commands found by name, errors turned into one line and an exit code.

A command is a module of this package with a function `command` (or a `typer.Typer` of that name, for a group).
Its module is imported when the command is called or its help is shown, so modules keep heavy imports inside
functions; `semdb --help` must stay instant.
"""

from __future__ import annotations

import errno
import gc
import importlib
import io
import os
import re
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from semdb.errors import SemdbError, UsageError
from semdb.shown import for_terminal

# name -> module[:attribute], in the order of the help; the attribute is `command` unless it says otherwise
COMMANDS: dict[str, str] = {
    "init": "semdb.cli.init",
    "recording": "semdb.cli.recording",
    "trajectory": "semdb.cli.trajectory",
    "ingest": "semdb.cli.ingest",
    "status": "semdb.cli.status",
    "retry": "semdb.cli.status:retry",
    "delete": "semdb.cli.delete",
    "refine": "semdb.cli.refine",
    "compact": "semdb.cli.compact",
    "align": "semdb.cli.align",
    "find": "semdb.cli.find",
    "changes": "semdb.cli.changes",
    "loops": "semdb.cli.loops",
    "localize": "semdb.cli.localize",
    "track": "semdb.cli.track",
    "evaluate": "semdb.cli.evaluate",
    "show": "semdb.cli.show",
    "export": "semdb.cli.export",
    "import": "semdb.cli.export:import_command",
    "sql": "semdb.cli.sql",
    "keypoints": "semdb.cli.keypoints",
    "models": "semdb.cli.models",
    "train": "semdb.cli.train",
    "evaluate-detector": "semdb.cli.evaluate_detector",
    "synth": "semdb.cli.synth",
    "serve": "semdb.cli.serve",
    "token": "semdb.cli.token",
    "doctor": "semdb.cli.doctor",
}

INTERRUPTED = 130  # 128 + SIGINT, as a shell reports it


def load_command(name: str) -> Any:
    """The click command (or group) registered as `name`. Raises ``KeyError`` for a name that is not registered."""
    module_name, _, attribute = COMMANDS[name].partition(":")
    target = getattr(importlib.import_module(module_name), attribute or "command")
    if isinstance(target, typer.Typer):
        group = typer.main.get_group(target)
        group.name = name
        return group
    single = typer.Typer(add_completion=False, rich_markup_mode=None)
    single.command(name)(target)
    return typer.main.get_command(single)


def refuse_empty(arguments: Sequence[str]) -> None:
    """Raises UsageError for a value that is given and empty, as ``--map ''`` and ``--map=`` are.

    That is what a shell makes of a variable that is not set: it would mean the default, or anything.
    """
    for before, value in zip(("", *arguments), arguments, strict=False):
        empty = re.fullmatch(r"(--[a-z][a-z-]*)=", value)
        if value == "" or empty:
            name = empty[1] if empty else before if before.startswith("--") else "an argument"
            raise UsageError(f"{name}: the value is empty; give one, or leave it out")


def report(error: BaseException) -> int:
    """Print what went wrong on stderr, one line without a traceback (``SEMDB_DEBUG=1`` shows it); the exit code."""
    if os.environ.get("SEMDB_DEBUG", "") not in {"", "0"}:
        for line in "".join(traceback.format_exception(error)).splitlines():
            print(for_terminal(line), file=sys.stderr)
    if isinstance(error, KeyboardInterrupt):
        print("semdb: interrupted", file=sys.stderr)
        return INTERRUPTED
    if isinstance(error, SemdbError):
        print(f"semdb: {for_terminal(error)}", file=sys.stderr)
        return error.exit_code
    if isinstance(error, OSError):
        name = f"{os.fsdecode(error.filename)}: " if isinstance(error.filename, str | bytes | os.PathLike) else ""
        print(f"semdb: {for_terminal(f'{name}{error.strerror or error}')}", file=sys.stderr)
        return 1
    raise error


# What typer raises for a command line that it cannot read; its message names words of it as they are.
_Misuse: Any = typer.BadParameter.__base__


class CommandGroup(TyperGroup):
    """Loads a command when it is named, and catches the errors of all of them."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        # only the names matter here: typer suggests from them when a command is mistyped
        self.commands = dict.fromkeys(COMMANDS, self)
        self._loaded: dict[str, Any] = {}

    def list_commands(self, ctx: Any) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name not in COMMANDS:
            return None
        if cmd_name not in self._loaded:
            self._loaded[cmd_name] = load_command(cmd_name)
        return self._loaded[cmd_name]

    def make_context(self, *given: Any, **more: Any) -> Any:
        try:
            return super().make_context(*given, **more)
        except _Misuse as error:
            raise _plain(error) from None

    def invoke(self, ctx: Any) -> Any:
        try:
            refuse_empty(ctx.args)
            return super().invoke(ctx)
        except _Misuse as error:
            raise _plain(error) from None
        except (SemdbError, OSError, KeyboardInterrupt) as error:
            if isinstance(error, OSError) and error.errno == errno.EPIPE:
                raise  # the reader of a pipe went away: typer ends quietly
            raise typer.Exit(report(error)) from None


def _plain(error: Any) -> Any:
    error.message = for_terminal(error.message)
    return error


app = typer.Typer(
    name="semdb",
    cls=CommandGroup,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(value: bool) -> None:
    if value:
        import semdb

        print(f"semdb {semdb.__version__}")
        raise typer.Exit(0)


def _install_completion(value: bool) -> None:
    if value:
        from semdb.cli.completion.shells import current_shell, install

        try:
            shell = current_shell()
            script = install(shell)
        except (SemdbError, OSError) as error:
            raise typer.Exit(report(error)) from None
        print(f"completion for {shell.name} is in {script}; {shell.start_file} loads it")
        print(f"it works in new terminals; in this one: source {script}")
        raise typer.Exit(0)


def _show_completion(value: bool) -> None:
    if value:
        from semdb.cli.completion.shells import current_shell

        try:
            print(current_shell().script, end="")
        except SemdbError as error:
            raise typer.Exit(report(error)) from None
        raise typer.Exit(0)


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    install_completion: Annotated[
        bool,
        typer.Option(
            "--install-completion",
            callback=_install_completion,
            is_eager=True,
            help="Make this shell (bash or zsh) complete commands, options and names, and exit.",
        ),
    ] = False,
    show_completion: Annotated[
        bool,
        typer.Option(
            "--show-completion", callback=_show_completion, is_eager=True, help="Print the script for it and exit."
        ),
    ] = False,
) -> None:
    """A visual semantic database: RGB-D recordings become rows to ask questions of, images become camera poses.

    Settings come from SEMDB_ environment variables; options override them. Exit codes: 0 done, 1 failed, 2 usage.
    """


def write_whatever_it_is() -> None:
    r"""No terminal of another encoding costs an answer: what it cannot show becomes ``\u53a8``."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Entry point of the `semdb` command."""
    if "_SEMDB_COMPLETE" in os.environ:  # a shell asks what fits where its cursor is
        from semdb.cli.completion import answer

        print(answer(typer.main.get_command(app)))
        return
    write_whatever_it_is()
    try:
        app(prog_name="semdb")
    except KeyboardInterrupt as error:  # before a command began
        sys.exit(report(error))
    finally:
        # Looking through all modules for cycles as they go took 0.3 s at the end of every command. Torch's compiler
        # counts what is left, and says so on stderr.
        if "torch" not in sys.modules:
            gc.freeze()


if __name__ == "__main__":
    main()
