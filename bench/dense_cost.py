"""What laying a query on the map costs: processor time of queries with and without it, in one run.

    python -m bench.dense_cost [RECORDING...] [--scene NAME]... [--keyframes 12] [--queries 12] [--json FILE]

Each image is asked by colour alone and with depth, twice: the first time fills what a localizer keeps of its keyframes.
*Without* has neither surfaces nor edges nor predicted views; a query *pays* where its answer has numbers of these. A
whole query is its description (networks, SURF) and its localization. Times are of this process, all threads: set
SEMDB_THREADS=1, and SEMDB_DETECTOR and SEMDB_ENCODER for recordings (scenes have exact masks and gist).
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.trust.scenes import HOW, recorded_scene, scene_world
from bench.trust.suites import NEGATIVE, World
from semdb.cli.options import load_settings
from semdb.evaluation.workspace import evaluation_store
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import make_localizer
from semdb.localization.localizer import Localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.perception.describe import describer_from_specs
from semdb.perception.model_choice import specs_for_ingest
from semdb.recordings import open_recordings
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION
from semdb.settings import Settings
from semdb.types import Description

OF_DENSE = ("surface_", "edge_", "view_")
WITHOUT = LocalizerOptions(surfaces=None, edges=None, views=None)


@dataclass(frozen=True, slots=True)
class Cost:
    """Milliseconds of the processor for one query; `pays` where it was laid on the map."""

    place: str
    how: str
    describe: float
    without: float
    dense: float
    pays: bool
    verdict: str


def costs(world: World, settings: Settings, count: int) -> Iterator[Cost]:
    """Those of `count` own queries of a world of one map, by colour and with depth each."""
    (plan,) = world.maps
    specs = specs_for_ingest(settings, (), has_masks=plan.recording.categories is not None)
    describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
    own = [query for query in world.queries() if query.asked[0].kind != NEGATIVE]
    pairs = [own[k : k + len(HOW)] for k in range(0, len(own), len(HOW))]
    chosen = [pairs[round(at)] for at in np.linspace(0, len(pairs) - 1, min(count, len(pairs)))]
    with evaluation_store(settings.database_url) as store:
        ingest_recording(plan.recording, store, describer, IngestOptions(map_name="m"), entries=list(plan.entries))
        refine_map(store, store.find_map("m"), kinds=FOR_LOCALIZATION)
        plain, dense = (
            make_localizer(store, store.find_map("m"), "index", options, settings=settings)
            for options in (WITHOUT, LocalizerOptions())
        )
        for timed in (False, True):
            for query in (query for pair in chosen for query in pair):
                picture = query.picture()
                started = time.process_time()
                found = describer.describe(picture.image, picture.depth, picture.camera, picture.instances)
                described = (time.process_time() - started) * 1000
                without, _, _ = _timed(plain, found)
                laid, pays, verdict = _timed(dense, found)
                if timed:
                    how = HOW[picture.depth is not None]
                    yield Cost(plan.name, how, described, without, laid, pays, verdict)


def _timed(localizer: Localizer, description: Description) -> tuple[float, bool, str]:
    started = time.process_time()
    found = localizer.localize(description)
    spent = (time.process_time() - started) * 1000
    return spent, any(name.startswith(OF_DENSE) for name in found.evidence), str(found.verdict)


def show(found: Sequence[Cost]) -> None:
    """As a table of Markdown. Ratios are of sums: of whole queries, and of those that pay and those that do not."""
    print("| | queries | pay | describe | without | with | whole query | of those that pay | of the others |")
    print("|" + "---|" * 9)
    for place, how in dict.fromkeys((one.place, one.how) for one in found):
        own = [one for one in found if (one.place, one.how) == (place, how)]
        paying, others = [one for one in own if one.pays], [one for one in own if not one.pays]
        mean = [float(np.mean([getattr(one, name) for one in own])) for name in ("describe", "without", "dense")]
        numbers = " | ".join(f"{value:.0f} ms" for value in mean)
        ratios = " | ".join(ratio(some) for some in (own, paying, others))
        print(f"| {place}, {how} | {len(own)} | {len(paying)} | {numbers} | {ratios} |")


def ratio(found: Sequence[Cost]) -> str:
    if not found:
        return "-"
    before = sum(one.describe + one.without for one in found)
    return f"{sum(one.describe + one.dense for one in found) / before:.2f}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--scene", action="append", default=[], help="a hard place of bench.trust, such as bare3")
    parser.add_argument("--keyframes", type=int, default=12, help="of recordings")
    parser.add_argument("--queries", type=int, default=12)
    parser.add_argument("--work", type=Path, help="rendered places are kept here and found again")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    settings, found = load_settings(), list[Cost]()
    of_scenes = settings.model_copy(update={"detector": "recorded", "encoder": "gist"})
    with tempfile.TemporaryDirectory() as folder:
        work = arguments.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        worlds = [(scene_world(name, work, _say), of_scenes) for name in arguments.scene]
        for recording in (one for path in arguments.recordings for one in open_recordings(path)):
            worlds.append((recorded_scene(recording, 0, arguments.keyframes), settings))
        for world, own in worlds:
            found += costs(world, own, arguments.queries)
            _say(f"{world.maps[0].name}: done")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps([asdict(one) for one in found], indent=1) + "\n")
    show(found)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
