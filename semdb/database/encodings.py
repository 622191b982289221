"""Vectors of keyframes by another encoder: written beside those that a map is asked by, then taken in their place.

`map_models` says which encoder's vectors count; all others are passed over. So a map whose keyframes are described
anew answers from its old vectors until all new ones are there, and one transaction switches.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

from sqlalchemy import Connection, Delete, Engine, Select, delete, func, insert, literal, select, update
from sqlalchemy.exc import IntegrityError

from semdb.database import checked, retry
from semdb.database.codecs import encode_array
from semdb.database.engine import check_packet
from semdb.database.ids import SharedIds, model_row
from semdb.database.moving import say_held
from semdb.database.reading import encoder_id
from semdb.database.records import ChangeKind, ImageKind, ItemState
from semdb.database.tables import (
    cnn_vectors,
    ingest_items,
    keyframe_changes,
    keyframe_images,
    keyframes,
    map_models,
    models,
    recordings,
)
from semdb.errors import DatabaseError, NotFoundError, UsageError
from semdb.types import Float32Array, ModelInfo

CHUNK = 500  # keyframes
HEAD = 4096  # bytes of an image file that say of what kind it is
_STATEMENT = 4096  # bytes beside blobs
Progress = Callable[[int, int], None]


def encoder_of(engine: Engine, info: ModelInfo, *, make: bool) -> int | None:
    """The id of an encoder, made known where it is not; without `make` None then."""
    if make:
        return SharedIds(engine).models([info])[info]
    query = select(models.c.id).where(models.c.digest == model_row(info)["digest"])
    found = retry.read(engine, lambda connection: connection.execute(query).scalar())
    return None if found is None else int(found)


def keyframes_without(engine: Engine, map_id: int, model_id: int | None) -> list[int]:
    """Ids of the keyframes of a map that have no vector by a model, ascending; of all for None."""
    return retry.read(engine, lambda connection: _without(connection, map_id, model_id))


def _without(connection: Connection, map_id: int, model_id: int | None) -> list[int]:
    k, c = keyframes.c, cnn_vectors.c
    query = select(k.id).join(recordings, recordings.c.id == k.recording_id).where(recordings.c.map_id == map_id)
    if model_id is not None:
        has = select(literal(1)).where(c.keyframe_id == k.id, c.model_id == model_id).exists()
        query = query.where(~has)
    return [int(key) for key in connection.execute(query.order_by(k.id)).scalars()]


def iter_image_kinds(engine: Engine, keyframe_ids: Sequence[int]) -> Iterator[ImageKind]:
    """What is stored of the images of keyframes, in the order of the ids; those that are gone are left out."""
    i, k = keyframe_images.c, keyframes.c
    head = func.substr(i.rgb, 1, HEAD).label("head")
    query = select(k.id, k.recording_id, k.frame_index, head).join(keyframe_images, i.keyframe_id == k.id)
    for start in range(0, len(keyframe_ids), CHUNK):
        keys = keyframe_ids[start : start + CHUNK]
        rows = {row.id: row for row in retry.read(engine, partial(_rows, query=query.where(k.id.in_(keys))))}
        for row in (rows[key] for key in keys if key in rows):
            name = f"keyframe_images.rgb of keyframe {row.id}"
            frame_index = checked.integer(row.frame_index, f"keyframes.frame_index of keyframe {row.id}")
            yield ImageKind(row.id, row.recording_id, frame_index, checked.blob(row.head, name))


def _rows(connection: Connection, query: Select[Any]) -> list[Any]:
    return list(connection.execute(query))


def add_vectors(engine: Engine, map_id: int, model_id: int, vectors: Mapping[int, Float32Array]) -> None:
    """Writes vectors ``[d]`` of a map's keyframes by a model, those that are not there yet, in one transaction.

    Keyframes that are gone go without. Where the model is the map's own, the log of changes has them: they had none.
    Raises UnstorableError for one that the server does not take.
    """

    def work(connection: Connection) -> None:
        k, c = keyframes.c, cnn_vectors.c
        there = set(connection.execute(select(k.id).where(k.id.in_(vectors))).scalars())
        known = select(c.keyframe_id).where(c.keyframe_id.in_(vectors), c.model_id == model_id)
        there -= set(connection.execute(known).scalars())
        for key in sorted(there):
            blob = encode_array(vectors[key].astype("<f4", copy=False))
            check_packet(connection, _STATEMENT + len(blob), f"the cnn_vectors row of keyframe {key}")
            connection.execute(insert(cnn_vectors), {"keyframe_id": key, "model_id": model_id, "vector": blob})
        if there and encoder_id(connection, map_id) == model_id:
            change = {"map_id": map_id, "kind": ChangeKind.REDESCRIBED.value}
            connection.execute(insert(keyframe_changes), [{**change, "keyframe_id": key} for key in sorted(there)])

    for _ in range(10):  # another process may do the same, or delete a keyframe, at the same time
        try:
            retry.write(engine, work)
        except IntegrityError:
            continue
        return
    raise DatabaseError("vectors could not be written: another process was always faster; run it again")


def switch_encoder(engine: Engine, map_id: int, model_id: int) -> int:
    """From here on a map is asked by its vectors of another encoder, if each keyframe has one: all or nothing.

    Returns how many keyframes have none, and then nothing is changed: 0 when it is done. Raises UsageError where a
    recording of the map is being ingested, NotFoundError for a map that is gone or empty.
    """
    return retry.write(engine, partial(_switch, map_id=map_id, model_id=model_id))


def _switch(connection: Connection, map_id: int, model_id: int) -> int:
    _hold(connection, map_id)
    lacking = _without(connection, map_id, model_id)
    if lacking:
        return len(lacking)
    if encoder_id(connection, map_id) == model_id:
        return 0  # done, by this one whose answer was lost or by another
    mine = (map_models.c.map_id == map_id, map_models.c.role == "encoder")
    if connection.execute(update(map_models).where(*mine).values(model_id=model_id)).rowcount != 1:
        raise NotFoundError(f"there is no map with the id {map_id} that an encoder describes: it was deleted meanwhile")
    kind = literal(ChangeKind.REDESCRIBED.value)
    k, r = keyframes.c, recordings.c
    changed = select(r.map_id, k.id, kind).join(recordings, r.id == k.recording_id).where(r.map_id == map_id)
    connection.execute(insert(keyframe_changes).from_select(["map_id", "keyframe_id", "kind"], changed.order_by(k.id)))
    return 0


def _hold(connection: Connection, map_id: int) -> None:
    """Waits for those who store keyframes of a map, and makes others wait: they change the same rows first.

    On other nodes of a cluster, too, where only rows that are written anew are at odds.
    """
    item, r = ingest_items.c, recordings.c
    own = select(r.id).where(r.map_id == map_id)
    connection.execute(update(ingest_items).where(item.recording_id.in_(own)).values(attempts=item.attempts))
    busy = select(r.name).join(ingest_items, item.recording_id == r.id)
    busy = busy.where(r.map_id == map_id, item.state == ItemState.RUNNING.value).limit(1)
    name = connection.execute(busy).scalar()
    if name is not None:
        raise UsageError(
            f"the recording {name!r} is being ingested, so its map keeps its vectors for now: when that is done, run "
            "this again, which does what is left"
        )
    for recording_id in list(connection.execute(own.order_by(r.id)).scalars()):
        say_held(connection, recording_id)


def drop_vectors(engine: Engine, map_id: int, keep: Sequence[int], progress: Progress | None = None) -> int:
    """Deletes vectors of a map's keyframes by models other than `keep`, in chunks. Returns how many."""
    k, c = keyframes.c, cnn_vectors.c
    query = select(c.keyframe_id, c.model_id).join(keyframes, k.id == c.keyframe_id)
    query = query.join(recordings, recordings.c.id == k.recording_id)
    query = query.where(recordings.c.map_id == map_id, c.model_id.not_in(keep)).order_by(c.keyframe_id, c.model_id)
    found = retry.read(engine, lambda connection: [(int(key), int(model)) for key, model in connection.execute(query)])
    done = 0
    for model in sorted({model for _, model in found}):
        keys = [key for key, own in found if own == model]
        for start in range(0, len(keys), CHUNK):
            some = keys[start : start + CHUNK]
            gone = delete(cnn_vectors).where(c.keyframe_id.in_(some), c.model_id == model)
            retry.write(engine, partial(_execute, statement=gone))
            done += len(some)
            if progress is not None:
                progress(done, len(found))
    return done


def _execute(connection: Connection, statement: Delete) -> None:
    connection.execute(statement)
