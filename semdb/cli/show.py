"""`semdb show`: pictures of keyframes and images with what is seen in them."""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from semdb.cli.options import JsonFlag, Overrides, open_database, settings_options
from semdb.shown import measure

if TYPE_CHECKING:
    from semdb.door.seen import Seen
    from semdb.door.values import Keyframe, SeenObject


# a name that ends so is a file, and not a folder; the first three are written, the others refused
PICTURES = (
    ".png",
    ".jpg",
    ".jpeg",
    ".webp",
    ".tif",
    ".tiff",
    ".bmp",
    ".gif",
    ".svg",
    ".pdf",
)  # the first three are written


@settings_options(models=True)
def command(
    what: Annotated[
        list[str], typer.Argument(metavar="KEYFRAME|IMAGE...", help="Ids of keyframes, as `semdb sql` shows; images.")
    ],
    overrides: Overrides,
    map_name: Annotated[
        str | None, typer.Option("--map", metavar="M", help="Map whose models describe images; default: the first.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="DIR|FILE", help="Write the pictures here; default: the current folder."),
    ] = None,
    json: JsonFlag = False,
) -> None:
    """Draw keyframes, or images, with their objects: masks, classes, scores, and how many keypoints there are.

    A number is a keyframe, unless there is a file of that name. An image is described by the models of the map, or by
    those of the settings where there is no map; it needs no camera.
    """
    from semdb.api import Keyframe
    from semdb.cli.output import JsonList, print_lines
    from semdb.cli.progress import say
    from semdb.door.seen import Seen
    from semdb.errors import FrameError, UsageError

    if out is not None and out.suffix.lower() in PICTURES and len(what) > 1:
        raise UsageError(f"--out {out}: is one file, and {len(what)} pictures are to be written; name a folder")
    broken: list[FrameError] = []

    def unreadable(error: FrameError) -> None:
        broken.append(error)
        say(str(error))

    taken: set[Path] = set()
    ids = [name for name in what if name.isascii() and name.isdigit() and not Path(name).exists()]
    images = [name for name in what if name not in ids]
    with open_database(overrides.settings()) as database, JsonList() if json else nullcontext() as printed:
        keyframes = (database.keyframe(int(name)) for name in ids)
        seen = database.describe_each(images, map=map_name, unreadable=unreadable) if images else iter(())
        for thing in chain[Keyframe | Seen](keyframes, seen):
            path = thing.save(picture_file(out, thing, taken))
            if printed is not None:
                printed.add({**as_dict(thing), "picture": str(path)})
            else:
                print_lines(*as_lines(thing), f"  wrote {path}")
    if broken:
        raise typer.Exit(1)


def picture_file(out: Path | None, thing: Keyframe | Seen, taken: set[Path]) -> Path:
    """Where the picture goes: ``keyframe-7.png``, ``photo-objects.png``. Names in `taken` are numbered on."""
    from semdb.door.seen import Seen

    if out is not None and out.suffix.lower() in PICTURES:
        return out
    folder = out or Path()
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"{Path(thing.image).stem}-objects" if isinstance(thing, Seen) else f"keyframe-{thing.id}"
    path, number = folder / f"{stem}.png", 1
    while path in taken:
        number += 1
        path = folder / f"{stem}-{number}.png"
    taken.add(path)
    return path


def as_lines(thing: Keyframe | Seen) -> list[str]:
    """What is printed for people."""
    from semdb.door.seen import Seen
    from semdb.pictures.drawing import description_facts

    if isinstance(thing, Seen):
        lines = [thing.image]
    else:
        x, y, z = thing.position
        where = f"frame {thing.frame_index} of {thing.recording}, map {thing.map}, at {x:.3f} {y:.3f} {z:.3f} m"
        lines = [f"keyframe {thing.id}: {where}"]
    counts = Counter(thing.keypoints.object_index.tolist())
    frame = "from the camera" if isinstance(thing, Seen) else "in the map"
    for ordinal, item in enumerate(thing.objects):
        place = "" if item.position is None else f", {' '.join(f'{v:.2f}' for v in item.position)} m {frame}"
        score = measure(item.score, 2, unless=(0.0, 1.0))
        held = f"{counts[ordinal]} keypoint{'' if counts[ordinal] == 1 else 's'}"
        lines.append(f"  {item.category} {score}: {_box(item)}, {held}{place}")
    facts = description_facts(len(thing.objects), thing.keypoints, points=not isinstance(thing, Seen))
    return [*lines, "  " + ", ".join(f"{value} {name}" for name, value in facts)]


def _box(item: SeenObject) -> str:
    x1, y1, x2, y2 = (round(float(value)) for value in item.box)
    return f"x {x1} to {x2}, y {y1} to {y2}"


def as_dict(thing: Keyframe | Seen) -> dict[str, Any]:
    """What is printed for programs."""
    from semdb.door.seen import Seen

    counts = Counter(thing.keypoints.object_index.tolist())
    own: dict[str, Any]
    if isinstance(thing, Seen):
        own = {"image": thing.image}
    else:
        own = {
            "keyframe": thing.id,
            "map": thing.map,
            "recording": thing.recording,
            "frame_index": thing.frame_index,
            "timestamp_ns": thing.timestamp_ns,
        }
    return {
        **own,
        "keypoints": len(thing.keypoints),
        "objects": [
            {
                "category": item.category,
                "score": item.score,
                "box": item.box,
                "position": item.position,
                "extent": item.extent,
                "keypoints": counts[ordinal],
            }
            for ordinal, item in enumerate(thing.objects)
        ],
    }
