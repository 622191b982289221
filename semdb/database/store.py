"""The store: what the rest of semdb sees of the database. Takes and returns frozen values, never rows."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, Engine, select

from semdb.class_score import ClassQuery, Part
from semdb.database import (
    change_log,
    class_filter,
    completions,
    deletion,
    lookups,
    planning,
    point_rows,
    reading,
    refinements,
    reporting,
    retry,
    scanning,
    schema,
)
from semdb.database.engine import make_engine, parse_url, safe_url, sqlite_path
from semdb.database.ids import SharedIds
from semdb.database.items import Claim
from semdb.database.left_out import MOST_SAID, LeftOut, once
from semdb.database.reading import Bad
from semdb.database.records import (
    Change,
    ChangeMark,
    ClassConfusion,
    Deleted,
    FailedItem,
    KeyframeHead,
    KeyframeRecord,
    ListedKeyframe,
    MapHead,
    MapInfo,
    MapObject,
    PlannedRecording,
    RecordingPlan,
    RecordingState,
    RecordingStatus,
    Refinement,
    ScoredKeyframe,
    StoredImage,
    StoredKeyframe,
    UsedCamera,
    WriteResult,
)
from semdb.database.sqlite_file import how_it_is_read
from semdb.database.tables import maps, recordings
from semdb.database.writing import KeyframeWriter
from semdb.errors import CodecError, NotFoundError, SchemaError
from semdb.names import storable
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, Int64Array, Localization, ModelInfo

Progress = Callable[[int, int], None]


def open_store(url: str, *, create: bool = False, say: Callable[[str], None] | None = None) -> Store:
    """The store at `url`, its schema checked.

    With `create` a SQLite file that is missing or empty is made; a server always needs `semdb init`. `say` takes lines
    for people about a file that can only be read, and about rows that are left out. Raises UsageError for a URL of
    another kind, DatabaseError when it does not answer, SchemaError for a schema that is missing, older or newer.
    """
    parsed = parse_url(url)
    path = sqlite_path(parsed)
    if path is not None and not path.exists() and not create:
        raise SchemaError(_no_file(path, safe_url(parsed)))
    if path is not None and say is not None and (line := how_it_is_read(path)) is not None:
        say(line)
    engine = make_engine(url)
    try:
        if path is not None and create and schema.current_revision(engine) is None:
            schema.upgrade(engine)
        schema.check_schema(engine)
    except BaseException:
        engine.dispose()
        raise
    return Store(engine, say)


def _no_file(path: Path, url: str) -> str:
    other = Path("/") / path
    hint = f"; {other} takes a fourth slash: sqlite:///{other}" if not path.is_absolute() and other.is_file() else ""
    return f"there is no database {url}: run `semdb init` or `semdb ingest` first{hint}"


class Store:
    """Reads and writes of a semantic database. Safe to share between threads; close it, or use it in a ``with``."""

    def __init__(self, engine: Engine, say: Callable[[str], None] | None = None) -> None:
        """`say` takes lines for people about rows that are left out."""
        self.engine = engine
        self.say = None if say is None else once(say)
        self.left_out = LeftOut(say)  # for `bad` of what reads many keyframes
        self._ids = SharedIds(engine)
        self._writer = KeyframeWriter(engine, self._ids)

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.engine.dispose()

    @property
    def url(self) -> str:
        """The URL without its password."""
        return safe_url(self.engine.url)

    # maps and recordings

    def ensure_map(self, name: str) -> int:
        """The id of the map `name`, made when it is not there. Raises UsageError for an impossible name."""
        return planning.ensure_map(self.engine, name)

    def maps(self) -> list[MapInfo]:
        """All maps by id."""
        return planning.list_maps(self.engine)

    def map_heads(self) -> list[MapHead]:
        """All maps by id, with what a query must be made with, at the price of three small queries."""
        return lookups.map_heads(self.engine)

    def find_map(self, name: str) -> MapInfo:
        """The map `name`. Raises NotFoundError, which names the maps there are."""
        known = self.maps()
        for info in known:
            if info.name == storable(name):
                return info
        names = ", ".join(info.name for info in known) or "none yet, run `semdb ingest` first"
        raise NotFoundError(f"there is no map {name!r} in {self.url}; maps: {names}")

    def map_models(self, map_id: int) -> tuple[ModelInfo, ...]:
        """The models that describe a map: detector, encoder, features; empty for an empty map."""
        return tuple(retry.read(self.engine, lambda c: planning.map_model_ids(c, map_id)))

    def check_models(self, map_id: int, models: Iterable[ModelInfo]) -> None:
        """Raises ProvenanceError, naming both, when the map is described by other models than `models`."""
        stored = self.map_models(map_id)
        name = retry.read(self.engine, lambda c: c.execute(select(maps.c.name).where(maps.c.id == map_id)).scalar())
        planning.check_models(stored, models, f"the map {name!r}")

    def find_recording(self, map_id: int, name: str) -> int:
        """The id of a recording. Raises NotFoundError."""
        query = select(recordings.c.id).where(recordings.c.map_id == map_id, recordings.c.name == name)
        found = retry.read(self.engine, lambda c: c.execute(query).scalar())
        if found is None:
            raise NotFoundError(f"there is no recording {name!r} in the map {map_id}")
        return int(found)

    def status(self, map_id: int | None = None) -> list[RecordingStatus]:
        """The recordings of a map, or of all maps, with what is planned and stored."""
        return reporting.status(self.engine, map_id)

    # ingest

    def plan_recording(self, map_id: int, plan: RecordingPlan, models: Sequence[ModelInfo]) -> PlannedRecording:
        """Record what is to be ingested, or find what is left of it: see `planning.plan_recording`."""
        return planning.plan_recording(self.engine, self._ids, map_id, plan, models)

    def write_keyframe(self, recording_id: int, record: KeyframeRecord, claimed: Claim | None = None) -> WriteResult:
        """Store one planned keyframe with all its rows in one transaction, once: see `KeyframeWriter.write`."""
        return self._writer.write(recording_id, record, claimed)

    def fail_item(self, recording_id: int, frame_index: int, error: str) -> None:
        """Note that a planned keyframe could not be described or stored."""
        planning.fail_item(self.engine, recording_id, frame_index, error)

    def failed_items(self, recording_id: int | None = None) -> list[FailedItem]:
        """The keyframes that failed, of one recording or of all."""
        return planning.failed_items(self.engine, recording_id)

    def finish_recording(self, recording_id: int) -> RecordingState:
        """Mark a recording complete when nothing of its plan is left to try. Returns its state."""
        return planning.finish_recording(self.engine, recording_id)

    # reading

    def class_query(self, map_id: int, counts: Mapping[str, float]) -> ClassQuery:
        """The query for objects per class, weighted by how rare the classes are in a map. Raises UsageError."""
        return class_filter.query_for(self.engine, map_id, counts)

    def class_filter(
        self,
        map_id: int,
        query: ClassQuery,
        minimum_share: float,
        at_most: int | None = None,
        completed: bool = False,
    ) -> list[ScoredKeyframe]:
        """Keyframes that show enough of the query's classes, best first: see `semdb.database.class_filter`."""
        return class_filter.class_filter(self.engine, map_id, query, minimum_share, at_most, completed)

    def completion_of(self, map_id: int) -> str | None:
        """The state of a map that its `completed` classes belong to; None where they are not to be used."""
        return completions.completion_of(self.engine, map_id)

    def class_scores(self, map_id: int, query: ClassQuery, keyframe_ids: Sequence[int]) -> dict[int, float]:
        """Class scores of these keyframes; those that share no class with the query are left out."""
        return class_filter.class_scores(self.engine, map_id, query, keyframe_ids)

    def document_frequencies(self, map_id: int, categories: Collection[str]) -> dict[str, int]:
        """How many keyframes of a map show a class."""
        return class_filter.document_frequencies(self.engine, map_id, categories)

    def keyframe_count(self, map_id: int) -> int:
        """How many keyframes a map holds."""
        return class_filter.keyframe_count(self.engine, map_id)

    def keyframe_ids(self, map_id: int) -> list[int]:
        """Ids of all keyframes of a map, ascending."""
        return reading.keyframe_ids(self.engine, map_id)

    def check_keyframes(self, keyframe_ids: Sequence[int]) -> None:
        """Raises NotFoundError, naming it, for a keyframe that is not there; damaged ones are."""
        reading.check_keyframes(self.engine, keyframe_ids)

    def load_vectors(self, keyframe_ids: Sequence[int]) -> Float32Array:
        """CNN vectors float32 ``[n, d]`` in the order of `keyframe_ids`. Raises NotFoundError, CodecError."""
        return reading.load_vectors(self.engine, keyframe_ids)

    def encoder_id(self, map_id: int) -> int | None:
        """The model whose vectors count in a map; None where it names none."""
        return retry.read(self.engine, lambda connection: reading.encoder_id(connection, map_id))

    def vectors_there(
        self, keyframe_ids: Int64Array, size: int | None = None, bad: Bad | None = None, encoder: int | None = None
    ) -> tuple[Int64Array, Float32Array]:
        """CNN vectors ``[n, d]`` of those keyframes that are there, and their ids: see `scanning.vectors_there`."""
        return scanning.vectors_there(self.engine, keyframe_ids, size, bad, encoder)

    def load_keyframes(
        self, keyframe_ids: Sequence[int], *, descriptors: bool = True, bad: Bad | None = None
    ) -> list[StoredKeyframe]:
        """Keyframes in the order of `keyframe_ids`. Raises NotFoundError; CodecError, or calls `bad` and leaves out."""
        return reading.load_keyframes(self.engine, keyframe_ids, with_descriptors=descriptors, bad=bad)

    def keyframe_heads(
        self,
        map_id: int,
        recording_id: int | None = None,
        *,
        after: int = 0,
        limit: int | None = None,
        bad: Bad | None = None,
    ) -> list[KeyframeHead]:
        """Keyframes of a map, or of a recording of it, without what is large, by ascending id, those after an id.

        A damaged one raises CodecError, or is left out and told to `bad`.
        """
        return reading.keyframe_heads(
            self.engine, map_id=map_id, recording_id=recording_id, after=after, limit=limit, bad=bad
        )

    def keyframe_heads_of(self, keyframe_ids: Sequence[int]) -> list[KeyframeHead]:
        """These keyframes without what is large, by ascending id. Raises NotFoundError for one that is not there."""
        return reading.keyframe_heads(self.engine, keys=keyframe_ids)

    def load_image(self, keyframe_id: int) -> StoredImage:
        """The colour and depth files of a keyframe as recorded. Raises NotFoundError, CodecError."""
        return reading.load_image(self.engine, keyframe_id)

    def load_masks(self, keyframe_id: int) -> tuple[BoolArray, ...]:
        """Object masks ``[H, W]`` of a keyframe, by ordinal. Raises CodecError."""
        return reading.load_masks(self.engine, keyframe_id)

    def poses(
        self, map_id: int, keyframe_ids: Sequence[int] | None = None, bad: Bad | None = None
    ) -> tuple[list[int], FloatArray]:
        """Ids (ascending) and poses ``[n, 4, 4]`` of a map's keyframes: all, or those of `keyframe_ids`.

        A pose that is none raises CodecError, or is left out and told to `bad`.
        """
        return reading.poses(self.engine, map_id, keyframe_ids, bad)

    def changes_since(self, map_id: int, change_id: int) -> list[Change]:
        """Changes of a map's keyframes after `change_id` (0: all), ascending."""
        return change_log.changes_since(self.engine, map_id, change_id)

    def change_ids_since(self, map_id: int, change_id: int) -> list[int]:
        """Ids of the changes after `change_id`, ascending, whatever they say."""
        return change_log.change_ids_since(self.engine, map_id, change_id)

    def change_mark(self, map_id: int, change_id: int) -> ChangeMark:
        """What the log of changes holds after `change_id`, in three numbers: equal marks, nothing new."""
        return change_log.change_mark(self.engine, map_id, change_id)

    def iter_vectors(
        self,
        map_id: int,
        chunk: int = scanning.CHUNK,
        size: int | None = None,
        bad: Bad | None = None,
        *,
        in_turn: bool = False,
    ) -> Iterator[tuple[Int64Array, Float32Array]]:
        """All vectors of a map in chunks: ids int64 ``[n]``, ascending, and ``[n, d]``: see `scanning.iter_vectors`."""
        return scanning.iter_vectors(self.engine, map_id, chunk, size, bad, in_turn=in_turn)

    def change_text(self, map_id: int, change_id: int) -> str | None:
        """All that the log of changes says in one row; None where there is no such row."""
        return change_log.change_text(self.engine, map_id, change_id)

    def coarse_rows(
        self,
        map_id: int,
        keyframe_ids: Int64Array,
        size: int | None = None,
        bad: Bad | None = None,
        completed: bool = False,
    ) -> scanning.CoarseRows:
        """Vectors and class counts of those keyframes that the map has, at one moment: see `scanning.coarse_rows`."""
        return scanning.coarse_rows(self.engine, map_id, keyframe_ids, size, bad, completed)

    def say_class_rows_that_are_none(self, map_id: int) -> None:
        """Says which keyframes of a map have objects per class that are no numbers, and count as none."""
        for key in scanning.class_rows_that_are_none(self.engine, map_id, MOST_SAID):
            error = CodecError(f"keyframe_categories of keyframe {key}: its objects per class are no numbers")
            self.left_out(key, error)

    def map_categories(self, map_id: int) -> list[tuple[int, str]]:
        """Ids and names of the classes that keyframes of a map show."""
        return scanning.map_categories(self.engine, map_id)

    def category_columns(
        self, map_id: int, category_id: int, completed: bool = False
    ) -> tuple[Int64Array, dict[Part, Int64Array]]:
        """Keyframes of a map that show a class, ascending, and how many objects, and how strongly."""
        return scanning.category_columns(self.engine, map_id, category_id, completed)

    def map_sums(self, map_id: int, completed: bool = False) -> scanning.MapSums:
        """Sums over a map that a mirror of it must have too."""
        return scanning.map_sums(self.engine, map_id, completed)

    def map_identity(self, map_id: int) -> str:
        """A map's name and when it was made; empty where there is none."""
        return scanning.map_identity(self.engine, map_id)

    def planned_frames(self, map_name: str, recording: str) -> tuple[int, ...]:
        """Frame indexes of the stored plan of a recording, ascending; empty where there is none."""
        return lookups.planned_frames(self.engine, map_name, recording)

    def find_plan(self, map_name: str, recording: str) -> planning.StoredPlan | None:
        """The stored plan of a recording of a map; None where there is none."""
        return planning.find_plan(self.engine, map_name, recording)

    def cameras(self, map_id: int) -> list[Camera]:
        """The different cameras of a map's keyframes; what is none is said, and left out, where somebody listens."""
        return lookups.map_cameras(self.engine, map_id, self.say)

    def used_cameras(self, map_id: int) -> list[UsedCamera]:
        """The cameras of a map's recordings, each with every recording that it took. One that is none is left out."""
        return lookups.used_cameras(self.engine, map_id)

    def recording_camera(self, recording_id: int) -> tuple[Camera, float | None]:
        """Camera and depth scale of a recording. Raises NotFoundError without keyframes."""
        return lookups.recording_camera(self.engine, recording_id)

    def category_counts(self, map_id: int) -> list[tuple[int, str, int]]:
        """Keyframe id, class and number of objects, of every keyframe of a map that shows any."""
        return lookups.category_counts(self.engine, map_id)

    # refinements

    def map_state(self, map_id: int) -> str:
        """What a map holds, in a line: see `semdb.database.refinements`."""
        return refinements.map_state(self.engine, map_id)

    def refinements(self, map_id: int | None = None) -> list[Refinement]:
        """What `semdb refine` computed of a map, or of all, and whether the map is still the same.

        Rows that are none are said, and left out, where somebody listens, or raise CodecError.
        """
        return refinements.list_refinements(self.engine, map_id, self.say)

    def iter_objects(
        self, map_id: int, progress: Progress | None = None, bad: Bad | None = None
    ) -> Iterator[MapObject]:
        """All objects of a map that have a place in it, in an order that does not depend on ids."""
        return refinements.iter_objects(self.engine, map_id, progress, bad)

    def replace_refinement(
        self,
        map_id: int,
        kind: str,
        state: str | None,
        parameters: Mapping[str, Any],
        write: Callable[[Connection, int, Any], int],
        result: Any,
    ) -> int:
        """Replace what a step computed, in one transaction: see `refinements.replace_refinement`."""
        return refinements.replace_refinement(
            self.engine, map_id, kind, state, parameters, lambda connection: write(connection, map_id, result)
        )

    def class_confusions(self, map_id: int) -> list[ClassConfusion]:
        """Which classes are taken for each other in a map, as of the last `semdb refine`.

        Rows that are none are said, and left out, where somebody listens, or raise CodecError.
        """
        return refinements.load_confusions(self.engine, map_id, self.say)

    def listed_keyframes(self, map_id: int) -> list[ListedKeyframe]:
        """All keyframes of a map in an order that does not depend on ids."""
        return point_rows.listed_keyframes(self.engine, map_id)

    def refined_points(self, keyframe_ids: Sequence[int], bad: Bad | None = None) -> dict[int, Float32Array]:
        """Refined points ``[n, 4]`` of those keyframes that have any: see `point_rows.load_points`."""
        return point_rows.load_points(self.engine, keyframe_ids, bad)

    # deletion and log

    def delete_recording(self, recording_id: int, progress: Progress | None = None) -> Deleted:
        """Delete a recording with all that belongs to it. Raises NotFoundError."""
        try:
            return deletion.delete_recording(self.engine, recording_id, progress)
        finally:
            self._writer.forget()

    def delete_map(self, map_id: int, progress: Progress | None = None) -> Deleted:
        """Delete a map with all its recordings. Raises NotFoundError."""
        try:
            return deletion.delete_map(self.engine, map_id, progress)
        finally:
            self._writer.forget()

    def delete_keyframes(self, keyframe_ids: Iterable[int], progress: Progress | None = None) -> int:
        """Delete keyframes with all that belongs to them. Returns how many there were."""
        try:
            return deletion.delete_keyframes(self.engine, keyframe_ids, progress)
        finally:
            self._writer.forget()

    def log_query(self, map_id: int, image: str, localization: Localization) -> int:
        """Add a localization to the log of queries. Returns the id of the row."""
        return reporting.log_query(self.engine, map_id, image, localization)
