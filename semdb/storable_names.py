"""Which names can be stored, and be compared alike by all servers: of maps, recordings and classes."""

from __future__ import annotations

from collections.abc import Iterable

from semdb.errors import ModelError

NAME_LENGTH = 255  # characters of a column


def name_problem(name: str) -> str | None:
    """What is wrong with a name, as the end of a sentence that begins with it; None where nothing is."""
    if not name:
        return "is empty"
    if name != name.strip():
        return "has a space at an end"
    if not name.isprintable():
        return "has a character that cannot be printed"
    if len(name) > NAME_LENGTH:
        return f"has {len(name)} characters, and {NAME_LENGTH} is the most"
    return None


def check_class_names(names: Iterable[str], where: str) -> None:
    """Raises ModelError where a class that a network knows has a name that cannot be stored."""
    for name in names:
        if (problem := name_problem(name)) is not None:
            raise ModelError(f"{where}: the class name {name[:60]!r} {problem}")
