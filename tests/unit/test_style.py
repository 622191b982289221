"""House rules that a machine can check."""

from __future__ import annotations

import re
import subprocess
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from semdb.cli.main import COMMANDS, load_command
from semdb.service.settings import ServeSettings
from semdb.settings import Settings

REPOSITORY = Path(__file__).resolve().parents[2]
LONGEST_FILE = 400
CODE = ("semdb", "migrations", "workers", "bench", "scripts")
# paths of one machine: home folders, and folders that no documentation needs to name
MACHINE_PATH = re.compile(r"(?<![\w.])/(?:home|Users|root|work|mnt/[a-z]+)/[\w.-]+")
REGISTRY = re.compile(r"--(?:extra-)?index-url|--find-links|--registry|trusted-host")


def tracked_files() -> list[Path]:
    """The text files of the repository, those not yet committed among them."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    files = [REPOSITORY / name for name in listed.stdout.splitlines()]
    return [file for file in files if file.is_file() and b"\0" not in file.read_bytes()[:4096]]


def commands() -> Iterator[tuple[str, Any]]:
    """Every command with its full name, the commands of groups included."""
    for name in COMMANDS:
        command = load_command(name)
        inner = getattr(command, "commands", None)
        if inner is None:
            yield name, command
        else:
            yield from ((f"{name} {inner_name}", inner_command) for inner_name, inner_command in inner.items())


def test_files_are_short() -> None:
    long_ones = []
    for folder in CODE:
        for file in (REPOSITORY / folder).rglob("*"):
            if file.suffix in {".py", ".sh"}:
                lines = len(file.read_text().splitlines())
                if lines > LONGEST_FILE:
                    long_ones.append(f"{file.relative_to(REPOSITORY)}: {lines} lines")
    if long_ones:
        warnings.warn(f"longer than {LONGEST_FILE} lines: {', '.join(long_ones)}", stacklevel=1)
    assert not [name for name in long_ones if int(name.split(": ")[1].split()[0]) > 1.5 * LONGEST_FILE]


@pytest.mark.parametrize("pattern", [MACHINE_PATH, REGISTRY], ids=["machine path", "registry"])
def test_files_name_no_machine_and_no_registry(pattern: re.Pattern[str]) -> None:
    found = []
    for file in tracked_files():
        if file.name in {"LICENSE", Path(__file__).name}:
            continue
        for number, line in enumerate(file.read_text(errors="replace").splitlines(), 1):
            if match := pattern.search(line):
                found.append(f"{file.relative_to(REPOSITORY)}:{number}: {match[0]}")
    assert not found, "\n".join(found)


def test_the_patterns_find_what_they_should() -> None:
    assert MACHINE_PATH.search("open('/home/ann/data.png')")
    assert not MACHINE_PATH.search("see docs/work/notes.md and https://example.org/home/page")


def test_the_lock_file_pins_every_dependency_and_nothing_else() -> None:
    import tomllib

    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["torch"], *extras["worker"], *extras["dev"]]
    pinned = {}
    for line in (REPOSITORY / "requirements" / "constraints.txt").read_text().splitlines():
        if not line.startswith("#"):
            match = re.fullmatch(r"([\w.-]+)==([\w.!+]+)", line)
            assert match, f"not an exact version: {line}"
            pinned[re.sub(r"[-_.]+", "-", match[1]).lower()] = match[2]

    from packaging.requirements import Requirement

    for text in wanted:
        requirement = Requirement(text)
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        assert name in pinned, f"{name} is not in the lock file: make lock"
        assert requirement.specifier.contains(pinned[name]), f"{text} does not admit {pinned[name]}: make lock"
    assert "semdb" not in pinned


def test_every_command_and_option_is_documented() -> None:
    text = (REPOSITORY / "docs" / "commands.md").read_text()
    sections = dict(re.findall(r"^#+ `semdb ([a-z -]+?)`.*?\n(.*?)(?=^#+ |\Z)", text, flags=re.M | re.S))
    groups = {name.split()[0] for name, _ in commands() if " " in name}
    assert set(sections) - groups == {name for name, _ in commands()}
    missing = []
    for name, command in commands():
        assert command.help, f"semdb {name} has no help"
        for parameter in command.params:
            names = [option for option in parameter.opts if option.startswith("--") and option != "--help"]
            if names and not any(f"{option}" in sections[name] for option in names):
                missing.append(f"semdb {name} {names[0]}")
    assert not missing, f"not in docs/commands.md: {missing}"


def test_every_setting_is_documented_with_its_default() -> None:
    text = (REPOSITORY / "docs" / "settings.md").read_text()
    documented = set(re.findall(r"^\| `(SEMDB_[A-Z_]+)`", text, flags=re.M))
    assert {f"SEMDB_{name.upper()}" for name in Settings.model_fields} <= documented
    for name, field in Settings.model_fields.items():
        (row,) = re.findall(rf"^\| `SEMDB_{name.upper()}` .*$", text, flags=re.M)
        default = "none" if field.default is None else f"`{field.default}`"
        assert default in row, f"docs/settings.md: SEMDB_{name.upper()} has the default {default}"


def test_every_setting_of_the_service_is_documented_with_its_default() -> None:
    text = (REPOSITORY / "docs" / "settings.md").read_text()
    for name, field in ServeSettings.model_fields.items():
        (row,) = re.findall(rf"^\| `SEMDB_SERVE_{name.upper()}` .*$", text, flags=re.M)
        default = "none" if field.default is None else f"`{field.default}`"
        assert default in row, f"docs/settings.md: SEMDB_SERVE_{name.upper()} has the default {default}"


# Where text goes to a terminal or into a page as it is; everything else goes through what escapes names (semdb.shown).
PRINTERS = ("cli/output.py", "cli/progress.py", "cli/main.py", "cli/ending.py")
RAW = re.compile(r"(?<![\w.])print\(|sys\.std(?:out|err)\.write\(|typer\.echo\(|from html import|html\.escape\(")
RAW_ALLOWED = {"semdb/cli/status.py": 1, "semdb/shown.py": 1}  # fixed text; the escaping


def test_text_reaches_terminals_and_pages_through_what_escapes_it() -> None:
    found = []
    for folder in ("semdb", "workers"):
        for file in sorted((REPOSITORY / folder).rglob("*.py")):
            name = file.relative_to(REPOSITORY).as_posix()
            if name.endswith(PRINTERS):
                continue
            lines = file.read_text().splitlines()
            raw = [f"{name}:{number}: {line.strip()}" for number, line in enumerate(lines, 1) if RAW.search(line)]
            found += raw[RAW_ALLOWED.get(name, 0) :]
    assert not found, "use print_lines, print_table, print_json, say, or for_html:\n" + "\n".join(found)


def test_groups_are_typer_apps() -> None:
    assert isinstance(__import__("semdb.cli.models", fromlist=["command"]).command, typer.Typer)
