"""Can a verdict be trusted? Thousands of negative, hard and positive queries; false localizations and calibration.

``python -m bench.trust [RECORDING...] [--synthetic] [--json FILE] [--plots DIR] [--work DIR]``, with SEMDB_DETECTOR and
SEMDB_ENCODER as for `semdb ingest`. Recordings are asked of each other's maps, so name at least two. `--synthetic`
renders rooms (some minutes; kept in `--work`). ``--scene bare3`` (or corridor, furnished, mirrored, and a number; as
often as one likes) asks hard places, ``--whole N`` all frames of the recordings beside N keyframes, with and without
depth; of both what `--json` holds already is not asked again. ``--again FILE`` judges what a file of `--json` holds
anew, without asking anything: for a change of the verdict or of the confidence. ``--fit fit`` (or ``test``) prints the
weights of the confidence that this half of the scenes gives.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from bench.trust.asking import USUAL, ask_world
from bench.trust.fit import fitted
from bench.trust.rows import Row, load_rows, report, save_plots, save_rows
from bench.trust.scenes import recorded_scene, scene_world
from bench.trust.suites import FIT, TEST, recorded_world, rendered_world
from semdb.cli.options import load_settings
from semdb.recordings import open_recordings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--synthetic", action="store_true")
    parser.add_argument("--scene", action="append", default=[], help="a hard place, such as bare3; repeatable")
    parser.add_argument("--queries", type=int, help="of each scene; default: all frames that are no keyframes")
    parser.add_argument("--whole", type=int, help="recordings are asked all frames, beside so many keyframes")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plots", type=Path)
    parser.add_argument("--work", type=Path, help="rendered rooms are kept here and found again")
    parser.add_argument("--again", type=Path, action="append", help="a file of --json to judge again")
    parser.add_argument("--fit", choices=(FIT, TEST), help="print the confidence's weights fitted on this half")
    parser.add_argument("--every", type=int, default=1, help="ask a part of the images, chosen by lot: one in n,")
    parser.add_argument("--first", type=int, default=0, help="and which of the n parts (0 to n - 1)")
    arguments = parser.parse_args()
    if not (arguments.recordings or arguments.synthetic or arguments.scene or arguments.again):
        parser.error("name recordings, or --synthetic, or --scene, or a file with --again")
    rows: list[Row] = []
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))  # as Ctrl-C: through the `finally` below
    try:
        if arguments.again is not None:
            rows += [row for path in arguments.again for row in load_rows(path)]
        else:
            if (arguments.scene or arguments.whole) and arguments.json is not None and arguments.json.exists():
                rows += load_rows(arguments.json)
            with tempfile.TemporaryDirectory(prefix="semdb-trust-") as folder:
                rows.extend(_ask_all(arguments, arguments.work or Path(folder), {row.map_name for row in rows}))
    finally:  # what was asked is kept, whatever ends it
        if arguments.json is not None:
            save_rows(arguments.json, rows)
    if arguments.plots is not None:
        save_plots(arguments.plots, rows)
    print(report(rows))
    if arguments.fit is not None:
        print(fitted(rows, arguments.fit))


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _ask_all(arguments: argparse.Namespace, work: Path, known: set[str]) -> Iterator[Row]:
    settings = load_settings()
    work.mkdir(parents=True, exist_ok=True)
    rendered = settings.model_copy(update={"detector": "recorded", "encoder": "gist"})
    for name in arguments.scene:
        if name not in known:
            # whole or not at all: what is there of a scene is not asked again
            yield from list(ask_world(scene_world(name, work, _say, arguments.queries), rendered, 1, 0, _say, USUAL))
    if arguments.synthetic:
        own = settings.model_copy(update={"detector": "recorded"})
        yield from ask_world(rendered_world(work, _say), own, arguments.every, arguments.first, _say)
    if arguments.whole:
        recordings = [found for path in arguments.recordings for found in open_recordings(path)]
        for number, recording in enumerate(recordings):
            world = recorded_scene(recording, number, arguments.whole)
            if world.maps[0].name not in known:
                yield from list(ask_world(world, settings, arguments.every, arguments.first, _say, USUAL))
    elif arguments.recordings:
        yield from ask_world(
            recorded_world(arguments.recordings, _say), settings, arguments.every, arguments.first, _say
        )


if __name__ == "__main__":
    main()
