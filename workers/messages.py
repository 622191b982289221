"""What messages may hold. The broker takes anything of anybody who reaches it; what makes no sense is refused once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from semdb.database.ids import check_name
from semdb.errors import UsageError
from semdb.ingestion.run import IngestOptions
from semdb.recordings import parse_camera
from semdb.recordings.credentials import refuse_credentials
from semdb.recordings.options import read_options
from semdb.recordings.roots import check_root

OPTIONS: dict[str, type] = {"keyframes": int, "stride": int, "camera": str, "reading": str}  # of a whole recording
MOST_FRAMES = 1024  # of one message; semdb sends 16
MOST_CHARACTERS = 4096  # of a path or another text
LARGEST_ID, LARGEST_INDEX = 2**63 - 1, 2**31 - 1  # of the columns


@dataclass(frozen=True, slots=True)
class ItemsMessage:
    """Keyframes to be described and stored."""

    recording_id: int
    source: str  # for people: where the recording is, the database says
    frames: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class PlanMessage:
    """A recording to be planned."""

    path: str
    options: IngestOptions


def items_message(given: Sequence[Any], named: Mapping[str, Any]) -> ItemsMessage:
    """Arguments of the task: recording_id, source, frames. Raises UsageError for what no worker could ever do."""
    values = _bound(("recording_id", "source", "frames"), 3, given, named)
    recording_id = _whole("recording_id", values["recording_id"], 1, LARGEST_ID)
    source = _text("source", values["source"])
    frames = values["frames"]
    if not isinstance(frames, list | tuple) or len(frames) > MOST_FRAMES:
        raise UsageError(f"frames: a list of at most {MOST_FRAMES} numbers is needed, not {_shown(frames)}")
    return ItemsMessage(recording_id, source, tuple(_whole("a frame", frame, 0, LARGEST_INDEX) for frame in frames))


def plan_message(given: Sequence[Any], named: Mapping[str, Any], roots: Sequence[str]) -> PlanMessage:
    """Arguments of the task: path, map_name, name, options. Raises UsageError for what no worker could ever do.

    A path is below `roots`, where there are any.
    """
    values = _bound(("path", "map_name", "name", "options"), 1, given, named)
    path = _text("path", values["path"])
    refuse_credentials(path)
    check_root(path, roots)
    names: dict[str, Any] = {}
    for what, kind in (("map_name", "map"), ("name", "recording")):
        names[what] = None if values[what] is None else check_name(kind, _text(what, values[what]))
    chosen = _options(values["options"])
    reading = read_options(chosen.pop("reading", ""))
    if "camera" in chosen:
        parse_camera(chosen["camera"])
    return PlanMessage(path, IngestOptions(reading=reading, **names, **chosen))


def _options(options: Any) -> dict[str, Any]:
    """Those that are set."""
    if options is None:
        return {}
    if not isinstance(options, dict):
        raise UsageError(f"options: names and values are needed, not {_shown(options)}")
    found: dict[str, Any] = {}
    for option, value in options.items():
        if option not in OPTIONS:
            raise UsageError(f"there is no option {_shown(option)}: {', '.join(OPTIONS)}")
        if value is None:
            continue
        found[option] = _text(option, value) if OPTIONS[option] is str else _whole(option, value, 1, LARGEST_INDEX)
    return found


def _bound(names: Sequence[str], needed: int, given: Sequence[Any], named: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments by name; None for those that may be left out."""
    values: dict[str, Any] = dict(zip(names, given, strict=False))
    wrong = [str(name) for name in named if name not in names or name in values]
    missing = [name for name in names[:needed] if name not in values and name not in named]
    if len(given) > len(names) or wrong or missing:
        raise UsageError(
            f"the arguments are {', '.join(names)}: {len(given)} are given"
            + (f"; {', '.join(missing)} missing" if missing else "")
            + (f"; {', '.join(wrong)[:60]} besides" if wrong else "")
        )
    return {**dict.fromkeys(names), **values, **named}


def _whole(what: str, value: Any, least: int, most: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise UsageError(f"{what}: a whole number from {least} to {most} is needed, not {_shown(value)}")
    return value


def _text(what: str, value: Any) -> str:
    if not isinstance(value, str) or not value or "\0" in value or len(value) > MOST_CHARACTERS:
        raise UsageError(f"{what}: 1 to {MOST_CHARACTERS} characters, no NUL, are needed, not {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    """The beginning of a value, for a line that stays a line; its kind where it is a container, which may be deep."""
    if isinstance(value, str):
        return repr(value[:40])
    if value is None or isinstance(value, bool | float):
        return repr(value)
    if isinstance(value, int):
        return str(value) if abs(value) < 10**40 else "a number of more than 40 digits"
    return f"a {type(value).__name__} of {len(value)}" if hasattr(value, "__len__") else f"a {type(value).__name__}"
