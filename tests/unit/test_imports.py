"""The direction of imports, those inside functions and for types too, is the one that docs/architecture.md draws."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDERS = {"semdb": "semdb", "workers": "semdb.workers", "migrations": "semdb.migrations"}
BESIDE = {"migrations": "database"}  # rooms that stand beside another one


@dataclass(frozen=True)
class Import:
    by: str  # module
    of: str  # module
    names: tuple[str, ...]
    line: int

    def __str__(self) -> str:
        return f"{self.by}:{self.line} imports {', '.join(self.names) or 'all'} of {self.of}"


def modules() -> dict[str, Path]:
    found = {}
    for folder, package in FOLDERS.items():
        for path in sorted((REPOSITORY / folder).rglob("*.py")):
            parts = path.relative_to(REPOSITORY / folder).with_suffix("").parts
            found[".".join((package, *parts)).removesuffix(".__init__")] = path
    return found


def imports(known: Mapping[str, Path]) -> Iterator[Import]:
    """Every import of ours by ours; one of a name that is a module counts as one of the module."""
    for name, path in known.items():
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Import):
                for alias in node.names:
                    if alias.name.split(".")[0] == "semdb":
                        yield Import(name, alias.name, (), node.lineno)
            elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "semdb":
                assert node.level == 0, f"{path}:{node.lineno}: imports are absolute"
                own = str(node.module)
                members = [alias.name for alias in node.names if f"{own}.{alias.name}" not in known]
                for alias in node.names:
                    if alias.name not in members:
                        yield Import(name, f"{own}.{alias.name}", (), node.lineno)
                if members:
                    yield Import(name, own, tuple(members), node.lineno)


MODULES = modules()
IMPORTS = [found for found in imports(MODULES) if found.by != found.of]


def room(module: str) -> str:
    """The first part below semdb: a package or a loose module; ``semdb`` itself is the door."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "api"


def drawn_floors() -> list[set[str]]:
    """Floors of the house, the ground first, from the lines with arrows in docs/architecture.md."""
    text = (REPOSITORY / "docs" / "architecture.md").read_text("utf-8")
    drawing = re.search(r"^```house\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert drawing is not None, "docs/architecture.md has no block ```house"
    floors = [set(re.findall(r"[a-z_]+", line)) for line in drawing.group(1).splitlines() if line.strip(" │↓")]
    return floors[::-1]


FLOOR_OF = {name: number for number, names in enumerate(drawn_floors()) for name in names}


def test_every_room_is_in_the_drawing() -> None:
    rooms = {room(name) for name in MODULES} - set(BESIDE)
    assert rooms <= set(FLOOR_OF), f"docs/architecture.md does not draw {sorted(rooms - set(FLOOR_OF))}"


def floor(module: str) -> int:
    name = room(module)
    return FLOOR_OF[BESIDE.get(name, name)]


def test_no_arrow_goes_up() -> None:
    wrong = [str(found) for found in IMPORTS if floor(found.of) > floor(found.by)]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("level", ["modules", "rooms"])
def test_there_is_no_circle(level: str) -> None:
    graph: dict[str, set[str]] = {}
    for found in IMPORTS:
        one, other = (found.by, found.of) if level == "modules" else (room(found.by), room(found.of))
        if one != other:
            graph.setdefault(one, set()).add(other)
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        pytest.fail("a circle: " + " <- ".join(error.args[1]))


def package(module: str) -> str:
    return module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]


def private_parts(found: Import) -> Iterator[str]:
    """Names with an underscore that the importing package has no business with."""
    own = package(found.by)
    parts = found.of.split(".")
    for number, part in enumerate(parts):
        if part.startswith("_") and ".".join(parts[:number]) != own:
            yield part
    yield from (name for name in found.names if name.startswith("_") and not name.startswith("__") and found.by != own)


def test_nobody_reaches_into_another_package() -> None:
    wrong = [f"{found} ({part})" for found in IMPORTS for part in private_parts(found)]
    assert not wrong, "\n".join(wrong)


def test_the_drawing_is_obeyed_by_something() -> None:
    """A test of this test: there are imports on every floor, lazy ones and ones for types among them."""
    assert len(IMPORTS) > 800
    assert {floor(found.by) for found in IMPORTS} >= set(range(1, max(FLOOR_OF.values()) + 1)) - {FLOOR_OF["api"]}
    assert any(found.of == "semdb.geometry.undistort" for found in IMPORTS)  # inside a function
