"""Asking the queries of a world of the maps that it makes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from bench.trust.rows import Row, make_row
from bench.trust.suites import Query, Say, World
from semdb.database.store import Store
from semdb.evaluation.workspace import evaluation_store
from semdb.ingestion.run import IngestOptions, ingest_recording
from semdb.localization.images import make_localizer
from semdb.localization.localizer import Localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.verdict import VerdictOptions
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.model_choice import specs_for_ingest
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION
from semdb.settings import Settings

# every pose is reported; the verdict is made afterwards, from the evidence, as a localizer makes it
ALL_POSES = LocalizerOptions(
    verdict=replace(VerdictOptions(), ambiguous_inliers=0, ambiguous_first_inliers=0), landmarks=None
)
USUAL = LocalizerOptions(
    landmarks=None
)  # poses are there as for anybody; nothing but what is in doubt is looked at again


def ask_world(
    world: World, settings: Settings, every: int, first: int, say: Say, options: LocalizerOptions = ALL_POSES
) -> Iterator[Row]:
    """Makes the maps of a world in a database of their own and asks its queries."""
    with_masks = world.maps[0].recording.categories is not None
    specs = specs_for_ingest(settings, (), has_masks=with_masks)
    describer = describer_from_specs(specs.detector, specs.encoder, specs.features, settings)
    with evaluation_store(settings.database_url) as store:
        localizers = _make_maps(world, store, describer, say, options)
        half = {plan.name: plan.half for plan in world.maps}
        started, asked, said = time.perf_counter(), 0, 0
        part = np.random.default_rng(0)  # in turn, with `every`, would favour what comes in turn
        for query in world.queries():
            if part.integers(every) != first:
                continue
            for row in _ask(world.name, query, describer, localizers, half, options.verdict):
                asked += 1
                yield row
            if asked // 50 > said:
                said = asked // 50
                say(f"{world.name}: {asked} queries asked, {time.perf_counter() - started:.0f} s")


def _make_maps(
    world: World, store: Store, describer: Describer, say: Say, options: LocalizerOptions
) -> dict[str, Localizer]:
    made = {}
    for plan in world.maps:
        ingest_recording(
            plan.recording, store, describer, IngestOptions(map_name=plan.name), entries=list(plan.entries)
        )
        refine_map(store, store.find_map(plan.name), kinds=FOR_LOCALIZATION)
        made[plan.name] = make_localizer(store, store.find_map(plan.name), "index", options)
        say(f"map {plan.name}: {len(plan.entries)} keyframes")
    return made


def _ask(
    world_name: str,
    query: Query,
    describer: Describer,
    localizers: dict[str, Localizer],
    half: dict[str, str],
    asked_with: VerdictOptions,
) -> Iterator[Row]:
    picture = query.picture()
    description = describer.describe(picture.image, picture.depth, picture.camera, picture.instances)
    for asked in query.asked:
        found = localizers[asked.map_name].localize(description)
        yield make_row(world_name, query, asked, half[asked.map_name], found, asked_with)
