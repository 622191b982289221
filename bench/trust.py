"""Can a verdict be trusted? Thousands of negative, hard and positive queries; false localizations and calibration.

``python -m bench.trust [RECORDING...] [--synthetic] [--json FILE] [--plots DIR] [--work DIR]``, with SEMDB_DETECTOR and
SEMDB_ENCODER as for `semdb ingest`. Recordings are asked of each other's maps, so name at least two. `--synthetic`
renders rooms (some minutes; kept in `--work`). ``--again FILE`` judges what a file of `--json` holds anew, without
asking anything: for a change of the verdict or of the confidence. ``--fit fit`` (or ``test``) prints the weights of the
confidence that this half of the scenes gives.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.trust_fit import fitted
from bench.trust_rows import Row, load_rows, make_row, report, save_plots, save_rows
from bench.trust_suites import FIT, TEST, Query, Say, World, recorded_world, rendered_world
from semdb.cli.options import load_settings
from semdb.database.store import Store
from semdb.evaluation.workspace import evaluation_store
from semdb.ingest import IngestOptions, ingest_recording
from semdb.localization.localizer import Localizer, LocalizerOptions
from semdb.localization.verdict import VerdictOptions
from semdb.localize import make_localizer
from semdb.model_choice import specs_for_ingest
from semdb.perception.describe import Describer, describer_from_specs
from semdb.refine import refine_map
from semdb.settings import Settings

# every pose is reported; the verdict is made afterwards, from the evidence, as a localizer makes it
ALL_POSES = LocalizerOptions(verdict=replace(VerdictOptions(), ambiguous_inliers=0, ambiguous_first_inliers=0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--synthetic", action="store_true")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--plots", type=Path)
    parser.add_argument("--work", type=Path, help="rendered rooms are kept here and found again")
    parser.add_argument("--again", type=Path, action="append", help="a file of --json to judge again")
    parser.add_argument("--fit", choices=(FIT, TEST), help="print the confidence's weights fitted on this half")
    parser.add_argument("--every", type=int, default=1, help="ask a part of the images, chosen by lot: one in n,")
    parser.add_argument("--first", type=int, default=0, help="and which of the n parts (0 to n - 1)")
    arguments = parser.parse_args()
    if not (arguments.recordings or arguments.synthetic or arguments.again):
        parser.error("name recordings, or --synthetic, or a file with --again")
    rows: list[Row] = []
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(1))  # as Ctrl-C: through the `finally` below
    try:
        if arguments.again is not None:
            rows += [row for path in arguments.again for row in load_rows(path)]
        else:
            with tempfile.TemporaryDirectory(prefix="semdb-trust-") as folder:
                rows.extend(_ask_all(arguments, arguments.work or Path(folder)))
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


def _ask_all(arguments: argparse.Namespace, work: Path) -> Iterator[Row]:
    settings = load_settings()
    work.mkdir(parents=True, exist_ok=True)
    if arguments.synthetic:
        own = settings.model_copy(update={"detector": "recorded"})
        yield from ask_world(rendered_world(work, _say), own, arguments.every, arguments.first, _say)
    if arguments.recordings:
        yield from ask_world(
            recorded_world(arguments.recordings, _say), settings, arguments.every, arguments.first, _say
        )


def ask_world(world: World, settings: Settings, every: int, first: int, say: Say) -> Iterator[Row]:
    """Makes the maps of a world in a database of their own and asks its queries."""
    with_masks = world.maps[0].recording.categories is not None
    specs = specs_for_ingest(settings, (), has_masks=with_masks)
    describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
    with evaluation_store(settings.database_url) as store:
        localizers = _make_maps(world, store, describer, say)
        half = {plan.name: plan.half for plan in world.maps}
        started, asked, said = time.perf_counter(), 0, 0
        part = np.random.default_rng(0)  # in turn, with `every`, would favour what comes in turn
        for query in world.queries():
            if part.integers(every) != first:
                continue
            for row in _ask(world.name, query, describer, localizers, half):
                asked += 1
                yield row
            if asked // 50 > said:
                said = asked // 50
                say(f"{world.name}: {asked} queries asked, {time.perf_counter() - started:.0f} s")


def _make_maps(world: World, store: Store, describer: Describer, say: Say) -> dict[str, Localizer]:
    made = {}
    for plan in world.maps:
        ingest_recording(
            plan.recording, store, describer, IngestOptions(map_name=plan.name), entries=list(plan.entries)
        )
        refine_map(store, store.find_map(plan.name))
        made[plan.name] = make_localizer(store, store.find_map(plan.name), "index", ALL_POSES)
        say(f"map {plan.name}: {len(plan.entries)} keyframes")
    return made


def _ask(
    world_name: str, query: Query, describer: Describer, localizers: dict[str, Localizer], half: dict[str, str]
) -> Iterator[Row]:
    picture = query.picture()
    description = describer.describe(picture.image, None, picture.camera, picture.instances)
    for asked in query.asked:
        found = localizers[asked.map_name].localize(description)
        yield make_row(world_name, query, asked, half[asked.map_name], found)


if __name__ == "__main__":
    main()
