"""Bare rooms: plain walls, plain furniture, one picture. What is localized of their own images and of other rooms'.

    python -m bench.bare --room N [--room N]... [--keyframes 12] [--queries 24] [--work DIR] [--json FILE]

Rooms are those of ``semdb synth --bare --noise``, once around in 48 frames. Each map is asked by frames of its room
that are no keyframes, by colour alone and with depth, and by every fourth of as many of the next room that is named.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from bench.visits import SAME, Answer, Place, Visit, evenly, make_map, rendered, save, show, started
from semdb.cli.options import load_settings
from semdb.database.store import open_store
from semdb.geometry import pose_error
from semdb.ingestion.keyframes import select_keyframes
from semdb.localization.images import make_localizer
from semdb.perception.describe import Describer, describer_from_specs
from semdb.recordings.synthetic import SyntheticOptions
from semdb.settings import Settings

LAP = 48
FOREIGN = 4  # one in so many queries is asked of the room before, too
FAR = float("inf")


def bare_room(work: Path, number: int, keyframes: int, queries: int) -> Place:
    """A bare room, kept in `work`."""
    options = SyntheticOptions(frames=LAP, lap_frames=LAP, seed=number, room_seed=number, noise=True, bare=True)
    recording = rendered(work / f"bare{number}", options)
    chosen = tuple(select_keyframes(recording, count=keyframes))
    rest = [entry for entry in recording.entries if entry not in chosen]
    name = f"bare{number}-{keyframes}"
    return Place(name, recording, chosen, (Visit(SAME, recording, tuple(evenly(rest, queries))),))


def answers(
    place: Place, other: Place | None, describer: Describer, settings: Settings, work: Path
) -> Iterator[Answer]:
    """Of the own queries and of those of another room, by colour alone and with depth."""
    path = work / f"{place.name}.sqlite3"
    if not path.exists():
        make_map(path, place, describer)
    asked = [(place, "", place.visits[0].entries)]
    if other is not None:
        asked.append((other, "another room, ", other.visits[0].entries[::FOREIGN]))
    with open_store(f"sqlite:///{path}") as store:
        localizer = make_localizer(store, store.find_map("m"), "sql", settings=settings)
        for source, what, entries in asked:
            for entry in entries:
                frame = source.recording.read(entry)
                for how, depth in (("colour alone", None), ("with depth", frame.depth)):
                    seen = describer.describe(frame.image, depth, frame.camera, frame.instances)
                    found = localizer.localize(seen)
                    error = (FAR, FAR)
                    if found.world_from_camera is not None and source is place:
                        assert entry.world_from_camera is not None
                        error = pose_error(found.world_from_camera, entry.world_from_camera)
                    yield Answer(
                        place.name, what + how, entry.index, 1.0, str(found.verdict), *error, found.confidence,
                        found.reason,
                    )  # fmt: skip


def main(given: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--room", type=int, action="append", required=True, help="seed of a room")
    parser.add_argument("--queries", type=int, default=24, help="of each room")
    arguments, found = started(parser, given)
    settings = load_settings().model_copy(update={"detector": "recorded", "encoder": "gist"})
    with tempfile.TemporaryDirectory() as folder:
        work = arguments.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        places = [bare_room(work, number, arguments.keyframes, arguments.queries) for number in arguments.room]
        describer = describer_from_specs("recorded", "gist", "surf", settings)
        for number, place in enumerate(places):
            if any(answer.place == place.name for answer in found):
                continue
            other = places[(number + 1) % len(places)] if len(places) > 1 else None
            found += answers(place, other, describer, settings, work)
            save(found, arguments.json)
        names = {place.name for place in places}
    show([answer for answer in found if answer.place in names])


if __name__ == "__main__":
    main()
