"""Images to poses: which map, which models, which camera; called by the command line and by programs."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from semdb.database.planning import check_models
from semdb.database.records import MapInfo
from semdb.database.refinements import CLASSES
from semdb.database.store import Store
from semdb.errors import DatabaseError, FrameError, NotFoundError, ProvenanceError, UsageError
from semdb.localization.index import IndexOptions, IndexSource, MapIndex
from semdb.localization.keyframe_cache import STALE, KeyframeCache
from semdb.localization.localizer import Localizer, LocalizerOptions
from semdb.localization.query_image import LikeCamera, QueryImage, QueryReader
from semdb.localization.sources import SqlSource
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.model_choice import settings_of_map, specs_for_query
from semdb.recordings import open_recordings
from semdb.settings import Settings
from semdb.types import Camera, Description, Localization, Verdict

COARSE = ("sql", "index")


@dataclass(frozen=True, slots=True)
class LocalizeOptions:
    """`like` is a recording's name in the database or its folder. `map_name` None asks every map."""

    map_name: str | None = None
    camera: Camera | None = None
    like: str | None = None
    coarse: str = "sql"
    localizer: LocalizerOptions = field(default_factory=LocalizerOptions)


@dataclass(frozen=True, slots=True, eq=False)
class ImageLocalization:
    """A localized image with what pictures need."""

    query: QueryImage
    description: Description
    localization: Localization


@dataclass(frozen=True, slots=True, eq=False)
class _MapLocalizer:
    info: MapInfo
    describer: Describer
    localizer: Localizer


def check_coarse(coarse: str) -> None:
    """Raises UsageError for what is neither ``sql`` nor ``index``."""
    if coarse not in COARSE:
        raise UsageError(f"--coarse {coarse}: known are sql and index")


def make_localizer(
    store: Store,
    info: MapInfo,
    coarse: str,
    options: LocalizerOptions | None = None,
    *,
    settings: Settings | None = None,
    say: Callable[[str], None] | None = None,
) -> Localizer:
    """The localizer of one map. Raises UsageError for a `coarse` that is neither ``sql`` nor ``index``.

    With `settings` an index is kept in their cache folder, and a query has as many threads as they say; without, it
    lives in memory alone.
    """
    check_coarse(coarse)
    source = SqlSource(store, info.id) if coarse == "sql" else IndexSource(open_index(store, info.id, settings, say))
    confusions: dict[str, dict[str, int]] = {}
    if say is not None and any(item.kind == CLASSES and not item.current for item in store.refinements(info.id)):
        say(f"map {info.name!r} has changed since semdb refine; the class confusions of then are used")
    for found in store.class_confusions(info.id):
        confusions.setdefault(found.category, {})[found.other] = found.weight
    if settings is not None:
        options = (options or LocalizerOptions()).with_threads(settings.threads)
    cache = KeyframeCache(store, info.id, refined=options is None or options.refined_points)
    if say is not None and cache.points == STALE:
        say(f"map {info.name!r} has changed since semdb refine; its refined points are not used: run semdb refine")
    return Localizer(info.name, store.map_models(info.id), source, cache, options, confusions)


def open_index(
    store: Store, map_id: int, settings: Settings | None = None, say: Callable[[str], None] | None = None
) -> MapIndex:
    """The index of a map as the settings have it."""
    if settings is None:
        return MapIndex.open(store, map_id, say=say)
    options = IndexOptions(exact_up_to=settings.index_exact_up_to, threads=settings.threads)
    return MapIndex.open(store, map_id, settings.cache_dir, options=options, say=say)


def localize_images(
    paths: Sequence[Path],
    depth_paths: Sequence[Path],
    store: Store,
    settings: Settings,
    options: LocalizeOptions | None = None,
    *,
    say: Callable[[str], None] | None = None,
    unreadable: Callable[[FrameError], None] | None = None,
) -> Iterator[ImageLocalization]:
    """Localizes images one by one; every answer is logged in `queries`.

    `depth_paths` is empty or has one depth image per image. Raises NotFoundError for a map that is not there or
    empty, ProvenanceError for models that did not make it, UsageError, FrameError for an image that cannot be read;
    with `unreadable` that is called instead, and the other images go on.
    """
    options = options or LocalizeOptions()
    if depth_paths and len(depth_paths) != len(paths):
        raise UsageError(f"{len(depth_paths)} depth images for {len(paths)} images: give --depth once per image")
    maps = _open_maps(store, settings, options, say)
    cameras = [camera for entry in maps for camera in store.cameras(entry.info.id)]
    reader = QueryReader(camera=options.camera, like=_like(store, maps, options.like), known=cameras, say=say)
    for number, path in enumerate(paths):
        started = time.perf_counter()
        try:
            query = reader.read(path, depth_paths[number] if depth_paths else None)
        except FrameError as error:
            if unreadable is None:
                raise
            unreadable(error)
            continue
        decode_ms = (time.perf_counter() - started) * 1000
        description, localization = _ask(maps, query)
        timing = {"decode": decode_ms, **description.timing_ms, **localization.timing_ms}
        timing["total"] = (time.perf_counter() - started) * 1000
        localization = replace(localization, timing_ms=timing)
        map_id = next(entry.info.id for entry in maps if entry.info.name == localization.map_name)
        _log(store, map_id, path, localization, say)
        yield ImageLocalization(query, description, localization)


def _log(store: Store, map_id: int, path: Path, localization: Localization, say: Callable[[str], None] | None) -> None:
    """An answer is given also where it cannot be logged, as with an account that may only read."""
    try:
        store.log_query(map_id, str(path), localization)
    except DatabaseError as error:
        if say is not None:
            say(f"the answer for {path} is not in the log of queries: {error}")


def _open_maps(
    store: Store, settings: Settings, options: LocalizeOptions, say: Callable[[str], None] | None
) -> list[_MapLocalizer]:
    """Localizers of the maps to ask. A map made by other models is an error when named, else left out aloud."""
    if options.map_name is not None:
        infos = [store.find_map(options.map_name)]
    else:
        infos = [info for info in store.maps() if info.keyframes]
    if not infos or not infos[0].keyframes:
        name = f"map {options.map_name!r}" if options.map_name else "the database"
        raise NotFoundError(f"{name} holds no keyframe: ingest a recording first (semdb ingest PATH)")
    describers: dict[object, Describer] = {}
    opened, refused = [], []
    for info in infos:
        try:
            opened.append(_open_map(store, info, settings, options, describers, say))
        except (ProvenanceError, UsageError) as error:
            if len(infos) == 1:
                raise
            refused.append(error)
            if say is not None:
                say(f"map {info.name!r} is not asked: {error}")
    if not opened:
        raise refused[0]
    return opened


def _open_map(
    store: Store,
    info: MapInfo,
    settings: Settings,
    options: LocalizeOptions,
    describers: dict[object, Describer],
    say: Callable[[str], None] | None,
) -> _MapLocalizer:
    models = store.map_models(info.id)
    specs = specs_for_query(settings, models)
    own = settings_of_map(settings, models)
    key = (specs, own.score_threshold, own.max_keypoints, own.classes, own.dynamic)
    if key not in describers:
        describers[key] = describer_from_specs(specs.detector, specs.encoder, specs.features, own)
    check_models(models, describers[key].models, f"the map {info.name!r}")
    localizer = make_localizer(store, info, options.coarse, options.localizer, settings=settings, say=say)
    return _MapLocalizer(info, describers[key], localizer)


def _ask(maps: Sequence[_MapLocalizer], query: QueryImage) -> tuple[Description, Localization]:
    """The best answer of all maps; two maps that both know the place make it ambiguous."""
    described: dict[Describer, Description] = {}
    answers: list[tuple[Description, Localization]] = []
    for entry in maps:
        if entry.describer not in described:
            described[entry.describer] = entry.describer.describe(
                query.image, query.depth, query.camera, query.instances
            )
        answers.append((described[entry.describer], entry.localizer.localize(described[entry.describer])))
    order = {Verdict.LOCALIZED: 2, Verdict.AMBIGUOUS: 1, Verdict.FAILED: 0}
    answers.sort(key=lambda answer: (order[answer[1].verdict], answer[1].inliers), reverse=True)
    description, best = answers[0]
    limit = maps[0].localizer.options.verdict.rival_share * best.inliers
    rivals = [other for _, other in answers[1:] if other.verdict is Verdict.LOCALIZED and other.inliers > limit]
    if best.verdict is Verdict.LOCALIZED and rivals:
        reason = f"map {rivals[0].map_name!r} fits as well: {rivals[0].inliers} against {best.inliers} inliers"
        best = replace(best, verdict=Verdict.AMBIGUOUS, confidence=min(best.confidence, 0.5), reason=reason)
    return description, best


def _like(store: Store, maps: Sequence[_MapLocalizer], name: str | None) -> LikeCamera | None:
    """The camera of a recording that the database knows by name, or of one on disk."""
    if name is None:
        return None
    for entry in maps:
        for known in store.status(entry.info.id):
            if known.name == name:
                camera, depth_scale = store.recording_camera(known.recording_id)
                return LikeCamera(camera, depth_scale, f"recording {name!r}")
    if Path(name).exists():
        recording = open_recordings(Path(name))[0]
        return LikeCamera(recording.camera, recording.depth_scale, str(recording.path))
    raise UsageError(f"--like {name}: neither a recording in the database nor a folder")
