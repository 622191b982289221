"""Images to poses: the localizer of a map as its rows and the settings have it, and an image with its answer."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from semdb.database.records import MapHead, MapInfo
from semdb.database.refinements import CLASSES
from semdb.database.store import Store
from semdb.errors import UsageError
from semdb.localization.coarse import CoarseSource
from semdb.localization.fallback import Fallback
from semdb.localization.index import IndexOptions, IndexSource, MapIndex
from semdb.localization.keyframe_cache import STALE, KeyframeCache
from semdb.localization.learned_matching import is_learned
from semdb.localization.localizer import Localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.query_image import QueryImage
from semdb.localization.sources import SqlSource
from semdb.perception.model_choice import dynamic_classes
from semdb.settings import Settings
from semdb.types import Description, Localization, ModelInfo

COARSE = ("sql", "index")


@dataclass(frozen=True, slots=True, eq=False)
class ImageLocalization:
    """A localized image with what pictures need. `unmasked`: nothing was filtered by class (see `unmasked.py`)."""

    query: QueryImage
    description: Description
    localization: Localization
    unmasked: bool = False


def check_coarse(coarse: str) -> None:
    """Raises UsageError for what is neither ``sql`` nor ``index``."""
    if coarse not in COARSE:
        raise UsageError(f"--coarse {coarse}: known are sql and index")


def make_localizer(
    store: Store,
    info: MapInfo | MapHead,
    coarse: str,
    options: LocalizerOptions | None = None,
    *,
    settings: Settings | None = None,
    say: Callable[[str], None] | None = None,
    fallback: Fallback | None = None,
) -> Localizer:
    """The localizer of one map. Raises UsageError for a `coarse` that is neither ``sql`` nor ``index``.

    With `settings` an index is kept in their cache folder, and a query has as many threads as they say; without, it
    lives in memory alone.
    """
    check_coarse(coarse)
    source = SqlSource(store, info.id) if coarse == "sql" else IndexSource(open_index(store, info.id, settings, say))
    return localizer_on(source, store, info, options, settings=settings, say=say, fallback=fallback)


def localizer_on(
    source: CoarseSource,
    store: Store,
    info: MapInfo | MapHead,
    options: LocalizerOptions | None = None,
    *,
    settings: Settings | None = None,
    say: Callable[[str], None] | None = None,
    fallback: Fallback | None = None,
) -> Localizer:
    """The localizer of one map whose coarse step asks `source`; `fallback` in place of that of the settings."""
    store.say_class_rows_that_are_none(info.id)
    confusions: dict[str, dict[str, int]] = {}
    if say is not None and any(item.kind == CLASSES and not item.current for item in store.refinements(info.id)):
        say(f"map {info.name!r} has changed since semdb refine; the class confusions of then are used")
    for found in store.class_confusions(info.id):
        confusions.setdefault(found.category, {})[found.other] = found.weight
    models = store.map_models(info.id)
    if settings is not None:
        options = with_matcher((options or LocalizerOptions()).with_threads(settings.threads), settings, models)
        fallback = fallback or fallback_of(settings, models)
    options = options or LocalizerOptions()
    cache = KeyframeCache(
        store,
        info.id,
        refined=options.refined_points,
        fallback=fallback if options.fallback else None,
        frames=options.frames > 0,
    )
    if say is not None and cache.points == STALE:
        say(f"map {info.name!r} has changed since semdb refine; its refined points are not used: run semdb refine")
    return Localizer(info.name, models, source, cache, options, confusions)


def fallback_of(settings: Settings, models: Sequence[ModelInfo]) -> Fallback | None:
    """The other feature that `settings` name for a map of `models`, with their matcher; None where it is the map's.

    Raises UsageError for a spec that is none, ModelError where a file is missing or is not what it should be.
    """
    if settings.features_fallback is None or not models:
        return None
    from semdb.perception.features import load_features
    from semdb.perception.matchers import load_matcher

    extractor = load_features(settings.features_fallback, settings)
    learned = is_learned([extractor.info])
    if settings.matcher is not None and not (learned or is_learned(models)):
        raise UsageError(
            f"SEMDB_MATCHER={settings.matcher} matches learned features, and SEMDB_FEATURES_FALLBACK is "
            f"{settings.features_fallback}: unset it, or name a fallback onnx:FILE"
        )
    if extractor.info in models:
        return None
    matcher = load_matcher(settings.matcher, settings) if settings.matcher is not None and learned else None
    return Fallback(extractor, matcher, dynamic_classes(models))


def with_matcher(options: LocalizerOptions, settings: Settings, models: Sequence[ModelInfo]) -> LocalizerOptions:
    """`options` with the matcher of `settings`, where they name one.

    Raises UsageError where the `models` of the map have no learned feature, or there is no such file.
    """
    if settings.matcher is None or not models or (settings.features_fallback and not is_learned(models)):
        return options
    feature = next((model.name for model in models if model.role == "features"), "none")
    if not is_learned(models):
        raise UsageError(
            f"SEMDB_MATCHER={settings.matcher} matches learned features, and the map was described by {feature}: unset "
            "it, or ingest with SEMDB_FEATURES=onnx:FILE"
        )
    from semdb.perception.matchers import load_matcher

    return replace(options, pose=replace(options.pose, matcher=load_matcher(settings.matcher, settings)))


def open_index(
    store: Store, map_id: int, settings: Settings | None = None, say: Callable[[str], None] | None = None
) -> MapIndex:
    """The index of a map as the settings have it."""
    if settings is None:
        return MapIndex.open(store, map_id, say=say)
    options = IndexOptions(exact_up_to=settings.index_exact_up_to, threads=settings.threads)
    return MapIndex.open(store, map_id, settings.cache_dir, options=options, say=say)
