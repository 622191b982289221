"""Which topics of a bag are colour, depth and their cameras: by type and first message, where nobody named them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from semdb.errors import RecordingError, UsageError
from semdb.recordings.options import ReadOptions
from semdb.recordings.ros_messages import is_depth
from semdb.recordings.ros_reader import COMPRESSED, IMAGE, INFO, Bag, Topic

TRANSPORTS = ("compressed", "compressedDepth", "theora", "ffmpeg", "zstd")
NOT_COLOR = re.compile(
    r"infra|(^|/|_)ir(\d|_|/|$)|confidence|mask|label|debug|theora|disparity|fisheye|gray|mono", re.IGNORECASE
)
REGISTERED = re.compile(r"aligned_depth|depth_registered|depth_to_color|registered", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Chosen:
    """The topics that are taken; None where there is none. `notes` say what else there was."""

    color: str
    depth: str | None
    color_info: str | None
    depth_info: str | None
    notes: tuple[str, ...] = ()


@dataclass(slots=True)
class _Images:
    color: list[str] = field(default_factory=list)
    depth: list[str] = field(default_factory=list)


def choose_topics(bag: Bag, options: ReadOptions) -> Chosen:
    """The topics to take. Raises RecordingError for a bag without colour, UsageError for a topic that it has not."""
    found = _sort_images(bag)
    notes: list[str] = []
    color = _choose(bag, options.color_topic, found.color, "--color-topic", "colour", _color_rank, notes)
    if color is None:
        raise RecordingError(no_images(bag, found.depth))
    depth = _choose(bag, options.depth_topic, found.depth, "--depth-topic", "depth", _depth_rank, notes)
    if depth in found.color:
        raise UsageError(f"--depth-topic {depth}: its images are no depth; {_has(bag, found.depth, 'depth images')}")
    infos = [topic.name for topic in bag.topics if topic.kind == INFO and topic.messages]
    if options.info_topic is not None and options.info_topic not in infos:
        raise UsageError(f"--info-topic {options.info_topic}: {_has(bag, infos, 'camera_info')}")
    color_info = options.info_topic or info_beside(color, infos)
    return Chosen(color, depth, color_info, None if depth is None else info_beside(depth, infos), tuple(notes))


def no_images(bag: Bag, depth: Sequence[str] = ()) -> str:
    """What is said of a bag without colour images: what it holds instead."""
    held = "; ".join(f"{topic.name} ({topic.kind}, {topic.messages})" for topic in bag.topics if topic.messages)
    held = " ".join(held.split())
    only = f"colour images: its images {', '.join(depth)} are depth" if depth else "images"
    return f"{bag.path}: has no {only}, so it makes no map. It holds {held or 'no message'}"


def info_beside(topic: str, infos: Sequence[str]) -> str | None:
    """The camera_info of an image's topic: its sibling, of the transport's parent, or the recorder's of RealSense."""
    base = topic
    while base.rsplit("/", 1)[-1] in TRANSPORTS:
        base = base.rsplit("/", 1)[0]
    folder = base.rsplit("/", 1)[0]
    candidates = [f"{folder}/camera_info", f"{base}/camera_info"]
    if base.endswith("/image/data"):
        candidates.append(f"{base.removesuffix('/image/data')}/info/camera_info")
    return next((name for name in candidates if name in infos), None)


def _sort_images(bag: Bag) -> _Images:
    """Topics of images with messages, by what their first message holds."""
    found = _Images()
    topics = [topic for topic in bag.topics if topic.kind in (IMAGE, COMPRESSED) and topic.messages]
    for topic in topics:
        if topic.name.endswith("/theora"):
            continue
        message = _first(bag, topic)
        if message is not None:
            (found.depth if is_depth(message, topic.name) else found.color).append(topic.name)
    return found


def _first(bag: Bag, topic: Topic) -> Any:
    for message in bag.messages([topic.name]):
        return bag.decode(message)
    return None


def _choose(
    bag: Bag, named: str | None, found: list[str], option: str, what: str, rank: Any, notes: list[str]
) -> str | None:
    names = [topic.name for topic in bag.topics if topic.kind in (IMAGE, COMPRESSED) and topic.messages]
    if named is not None:
        if named not in names:
            raise UsageError(f"{option} {named}: {_has(bag, names, 'images')}")
        return named
    if not found:
        return None
    ordered = sorted(found, key=lambda name: (rank(name), name))
    if len(ordered) > 1:
        notes.append(f"{what} from {ordered[0]}; {option} takes {', '.join(ordered[1:])}")
    return ordered[0]


def _color_rank(name: str) -> tuple[bool, bool, bool, bool]:
    """Low is good: nothing that is no colour, a name that says colour, left before right, raw before compressed."""
    lower = name.lower()
    says_color = any(word in lower for word in ("color", "rgb"))
    return bool(NOT_COLOR.search(name)), not says_color, "right" in lower, name.rsplit("/", 1)[-1] in TRANSPORTS


def _depth_rank(name: str) -> tuple[bool, bool, bool]:
    """Low is good: registered to colour, a name that says depth, raw before compressed."""
    return not REGISTERED.search(name), "depth" not in name.lower(), name.rsplit("/", 1)[-1] in TRANSPORTS


def _has(bag: Bag, names: Sequence[str], what: str) -> str:
    return f"{bag.path} has no such topic of {what}; it has {', '.join(names) or 'none'}"
