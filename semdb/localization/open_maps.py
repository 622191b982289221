"""The maps of a database, open to queries: networks, indexes and keyframes stay from one query to the next."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from semdb.database.planning import check_models
from semdb.database.records import MapHead, UsedCamera
from semdb.database.store import Store
from semdb.errors import CodecError, ModelError, NotFoundError, ProvenanceError, UsageError
from semdb.localization.coarse import CoarseSource
from semdb.localization.images import ImageLocalization, check_coarse, localizer_on, open_index
from semdb.localization.index import IndexSource, MapIndex
from semdb.localization.localizer import Localizer
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.query_image import QueryImage, at_scale
from semdb.localization.query_scale import times_finer
from semdb.localization.shared import SharedSource
from semdb.localization.sources import SqlSource
from semdb.localization.unmasked import describe_query, lacks_masks, with_reason
from semdb.names import storable
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.model_choice import settings_of_map, specs_for_query
from semdb.settings import Settings
from semdb.types import Camera, Description, Localization, Tolerance, Verdict

RIVAL_CONFIDENCE = 0.5  # at most, where another map fits as well


@dataclass(frozen=True, slots=True, eq=False)
class OpenMap:
    """A map that can be asked, by any number of threads."""

    head: MapHead
    describer: Describer
    localizer: Localizer


class OpenMaps:
    """Opens the maps of `store` when they are first asked, and again when other models or steps made them.

    What other processes do to keyframes reaches the localizers by the log of changes. Threads may share it: they open
    maps one after the other, and ask side by side.
    """

    def __init__(
        self,
        store: Store,
        settings: Settings,
        options: LocalizerOptions | None = None,
        say: Callable[[str], None] | None = None,
    ) -> None:
        self._store = store
        self._settings = settings
        self._options = options
        self._say = say
        self._told: set[str] = set()
        self._opening = threading.Lock()
        self._open: dict[tuple[int, str], OpenMap] = {}
        self._indexes: dict[int, tuple[MapHead, MapIndex]] = {}
        self._describers: dict[object, Describer] = {}

    def asked(self, map_name: str | None, coarse: str) -> list[OpenMap]:
        """The map of that name, or all that hold keyframes, as they are now, with the coarse step ``sql`` or ``index``.

        A map whose models are not at hand, or whose rows are damaged, is an error when it is the only one, else it is
        left out aloud. Raises NotFoundError for a map that is not there or empty, ProvenanceError for models that did
        not make it, UsageError, CodecError.
        """
        check_coarse(coarse)
        heads = self._store.map_heads()
        self._drop_deleted(heads)
        if map_name is not None:
            wanted = [head for head in heads if head.name == storable(map_name)]
            if not wanted:
                self._store.find_map(map_name)  # says which there are
        else:
            wanted = [head for head in heads if head.holds_keyframes]
        if not wanted or not wanted[0].holds_keyframes:
            name = f"map {map_name!r}" if map_name is not None else "the database"
            raise NotFoundError(f"{name} holds no keyframe: ingest a recording first (semdb ingest PATH)")
        opened: list[OpenMap] = []
        refused: list[Exception] = []
        for head in wanted:
            try:
                opened.append(self._as_it_is(head, coarse))
            except (ProvenanceError, UsageError, CodecError, ModelError) as error:
                if len(wanted) == 1:
                    raise
                refused.append(error)
                self._tell(f"map {head.name!r} is not asked: {error}")
        if not opened:
            raise refused[0]
        return opened

    def cameras(self, maps: Sequence[OpenMap]) -> list[Camera]:
        """The cameras of the keyframes of `maps`."""
        return [camera for entry in maps for camera in self._store.cameras(entry.head.id)]

    def used_cameras(self, maps: Sequence[OpenMap]) -> list[UsedCamera]:
        """The cameras of the recordings of `maps`, with the names of both."""
        return [used for entry in maps for used in self._store.used_cameras(entry.head.id)]

    def close(self) -> None:
        """Writes what indexes have not on disk yet, for the next start; nothing is open then."""
        with self._opening:
            indexes, self._indexes = self._indexes, {}
            self._open, self._describers = {}, {}
        for _, index in indexes.values():
            index.close()

    def _tell(self, line: str) -> None:
        """Once: a map that is refused is so for every image."""
        if self._say is not None and line not in self._told:
            self._told.add(line)
            self._say(line)

    def _drop_deleted(self, heads: Sequence[MapHead]) -> None:
        there = {head.id for head in heads}
        if any(key[0] not in there for key in list(self._open)):
            with self._opening:
                self._open = {key: entry for key, entry in self._open.items() if key[0] in there}
                self._indexes = {key: entry for key, entry in self._indexes.items() if key in there}

    def _as_it_is(self, head: MapHead, coarse: str) -> OpenMap:
        if head.damage:
            raise CodecError(head.damage)
        known = self._open.get((head.id, coarse))
        if known is not None and known.head == head:
            return known
        with self._opening:
            known = self._open.get((head.id, coarse))  # another thread may have opened it meanwhile
            if known is not None and known.head != head == replace(known.head, measured=head.measured):
                known.localizer.cache.measured_anew()  # nothing else of the map is another
                known = self._open[head.id, coarse] = replace(known, head=head)
            if known is None or known.head != head:
                known = OpenMap(head, self._describer(head), self._localizer(head, coarse))
                self._open[head.id, coarse] = known
                used = {id(entry.describer) for entry in self._open.values()}
                self._describers = {key: item for key, item in self._describers.items() if id(item) in used}
            return known

    def _describer(self, head: MapHead) -> Describer:
        specs = specs_for_query(self._settings, head.models)
        own = settings_of_map(self._settings, head.models)
        key = (specs, own.encoder_crop, own.score_threshold, own.max_keypoints, own.classes, own.dynamic)
        if key not in self._describers:
            self._describers[key] = describer_from_specs(specs.detector, specs.encoder, specs.features, own)
        check_models(head.models, self._describers[key].models, f"the map {head.name!r}")
        return self._describers[key]

    def _localizer(self, head: MapHead, coarse: str) -> Localizer:
        if coarse == "sql":
            sql = SqlSource(self._store, head.id)  # which threads share

            def source() -> CoarseSource:
                return sql

        else:
            index = self._index(head)

            def source() -> CoarseSource:
                return IndexSource(index)

        localizer = localizer_on(source(), self._store, head, self._options, settings=self._settings, say=self._say)
        localizer.source = SharedSource(source, localizer.cache)
        return localizer

    def _index(self, head: MapHead) -> MapIndex:
        known = self._indexes.get(head.id)
        if known is not None and known[0].models == head.models:
            return known[1]
        index = open_index(self._store, head.id, self._settings, self._say)
        self._indexes[head.id] = head, index
        return index


def ask(
    maps: Sequence[OpenMap],
    query: QueryImage,
    cameras: Callable[[OpenMap], Sequence[Camera]] | None = None,
    say: Callable[[str], None] | None = None,
    accept: Tolerance | None = None,
) -> ImageLocalization:
    """The best answer of all `maps`; two maps that both know the place make it ambiguous.

    `query` is no finer than the finest of them; of several, `cameras` says what took the images of each, so that each
    is asked at its own scale. Poses within `accept` are one for the caller. A map that is too damaged to answer is left
    out and told to `say` where another one answers. Raises FrameError, ModelError, DatabaseError.
    """
    described: dict[tuple[Describer, Camera], Description] = {}
    answers: list[tuple[QueryImage, Description, Localization, bool]] = []
    refused: list[CodecError] = []
    for entry in maps:
        known = cameras(entry) if cameras is not None and len(maps) > 1 else ()
        scaled = at_scale(query, times_finer(query.camera, known))
        key = entry.describer, scaled.camera
        if key not in described:
            described[key] = describe_query(entry.describer, scaled)
        try:
            found = entry.localizer.localize(described[key], accept)
        except CodecError as error:
            refused.append(error)
            if say is not None and len(maps) > 1:
                say(f"map {entry.head.name!r} does not answer: {error}")
        else:
            answers.append((scaled, described[key], found, lacks_masks(entry.describer, scaled)))
    if not answers:
        raise refused[0]
    order = {Verdict.LOCALIZED: 3, Verdict.AMBIGUOUS: 2, Verdict.COARSE: 1, Verdict.FAILED: 0}
    answers.sort(key=lambda answer: (order[answer[2].verdict], answer[2].inliers), reverse=True)
    query, description, best, unmasked = answers[0]
    limit = maps[0].localizer.options.verdict.rival_share * best.inliers
    rivals = [other for _, _, other, _ in answers[1:] if other.verdict is Verdict.LOCALIZED and other.inliers > limit]
    if best.verdict is Verdict.LOCALIZED and rivals:
        reason = f"map {rivals[0].map_name!r} fits as well: {rivals[0].inliers} against {best.inliers} inliers"
        confidence = min(best.confidence, RIVAL_CONFIDENCE)
        best = replace(best, verdict=Verdict.AMBIGUOUS, confidence=confidence, reason=reason)
    return ImageLocalization(query, description, with_reason(best) if unmasked else best, unmasked)
