"""Rows of landmarks: what they are made of, and writing them so that ids live on.

Algorithms know no ids. Which id a landmark of a new computation gets is decided by `keep`, from the objects that the
landmarks of the last one have and those of the new ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from sqlalchemy import Connection, Engine, Table, delete, insert, literal, select, update

from semdb.database import checked, retry
from semdb.database.codecs import encode_array
from semdb.database.completions import STEP, replace_completions
from semdb.database.ids import new_id
from semdb.database.landmark_records import (
    GravityRow,
    KeyframeDepth,
    KeyframeObject,
    LandmarkRow,
    LandmarkSet,
)
from semdb.database.landmark_tables import (
    landmark_categories,
    landmark_merges,
    landmark_relations,
    landmark_sightings,
    landmark_views,
    landmark_visits,
    landmarks,
    map_gravity,
)
from semdb.database.reading import Bad, depth_scale_of, keyframe_heads
from semdb.database.records import KeyframeHead
from semdb.database.row_changes import delete_keys, insert_rows, update_rows, write_groups
from semdb.database.tables import categories, keyframe_images, objects, recordings
from semdb.errors import CodecError

LANDMARKS = STEP
NOT_READ = b"-"
CHUNK = 500
READ_CHUNK = 16  # keyframes
VISIT_COUNTS = ("keyframes", "points", "seen", "seen_through", "occluded", "missed")
_UP = ("up_x", "up_y", "up_z")


class Identities(Protocol):
    """Which ids new landmarks get (None: a new one), and which new landmark took in an old id."""

    @property
    def ids(self) -> Sequence[int | None]: ...

    @property
    def merged(self) -> Mapping[int, int]: ...


Keep = Callable[[Mapping[int, int], Sequence[Sequence[int]]], Identities]


def iter_keyframe_depths(
    engine: Engine, map_id: int, bad: Bad | None = None, known: Callable[[KeyframeHead], bool] = lambda _: False
) -> Iterator[list[KeyframeDepth]]:
    """The keyframes of a map by recording's name and frame, in chunks, each read in a transaction of its own.

    One that is deleted meanwhile is left out; a damaged one is told to `bad`, or raises CodecError. Of those that are
    `known` neither images nor masks are read: they are `NOT_READ`.
    """
    heads = keyframe_heads(engine, map_id=map_id, bad=bad)
    heads.sort(key=lambda head: (head.recording, head.frame_index))
    for start in range(0, len(heads), READ_CHUNK):
        chunk = heads[start : start + READ_CHUNK]
        light = [head.id for head in chunk if known(head)]
        images, things = _rows_of(engine, [head.id for head in chunk if head.id not in light])
        if light:
            of_light = _rows_of(engine, light, light=True)
            images, things = images | of_light[0], things | of_light[1]
        found = []
        for head in chunk:
            if head.id not in images:
                continue
            try:
                found.append(_keyframe(head, images[head.id], things.get(head.id, [])))
            except CodecError as error:
                if bad is None:
                    raise
                bad(head.id, error)
        yield found


def _rows_of(
    engine: Engine, keys: Sequence[int], *, light: bool = False
) -> tuple[dict[int, Any], dict[int, list[Any]]]:
    i, o = keyframe_images.c, objects.c
    rgb, depth = (checked.up_to(column, checked.MOST_FILE) for column in (i.rgb, i.depth))
    mask = checked.up_to(o.mask, checked.MOST_MASK)
    if light:
        rgb, depth, mask = (literal(NOT_READ).label(column.name) for column in (rgb, depth, mask))
    of_images = select(i.keyframe_id, rgb, depth, i.depth_scale, i.depth_registration).where(i.keyframe_id.in_(keys))
    of_objects = (
        select(o.id, o.keyframe_id, o.score, o.y1, o.y2, mask, categories.c.name)
        .select_from(objects.join(categories, categories.c.id == o.category_id))
        .where(o.keyframe_id.in_(keys))
        .order_by(o.keyframe_id, o.ordinal)
    )

    def work(connection: Connection) -> tuple[dict[int, Any], dict[int, list[Any]]]:
        things: dict[int, list[Any]] = {}
        for row in connection.execute(of_objects):
            things.setdefault(int(row.keyframe_id), []).append(row)
        return {int(row.keyframe_id): row for row in connection.execute(of_images)}, things

    return retry.read(engine, work)


def _keyframe(head: KeyframeHead, image: Any, things: Sequence[Any]) -> KeyframeDepth:
    where = f"of keyframe {head.id}"
    found = []
    for row in things:
        name = f"objects.mask of object {row.id} (keyframe {head.id})"
        category = checked.text(row.name, f"categories.name of an object {where}")
        score = checked.real(row.score, f"objects.score of object {row.id}", 0.0, 1.0)
        found.append(KeyframeObject(int(row.id), category, score, checked.blob(row.mask, name), _height(row, head)))
    depth = None if image.depth is None else checked.blob(image.depth, f"keyframe_images.depth {where}")
    return KeyframeDepth(
        id=head.id,
        recording=head.recording,
        frame_index=head.frame_index,
        timestamp_ns=head.timestamp_ns,
        camera=head.camera,
        world_from_camera=head.world_from_camera,
        rgb=checked.blob(image.rgb, f"keyframe_images.rgb {where}"),
        depth=depth,
        depth_scale=depth_scale_of(image.depth_scale, head.id),
        depth_registration=checked.text(image.depth_registration, f"keyframe_images.depth_registration {where}", 32),
        objects=tuple(found),
    )


def _height(row: Any, head: KeyframeHead) -> float:
    """Where the middle of an object's box is in the image, 0 at the top to 1 at the bottom."""
    y1, y2 = (
        checked.real(getattr(row, name), f"objects.{name} of object {row.id}", -1e6, 1e6) for name in ("y1", "y2")
    )
    return (y1 + y2 + 1) / (2 * head.camera.height)


def replace_landmarks(connection: Connection, map_id: int, found: LandmarkSet, keep: Keep) -> int:
    """Make the landmarks of a map these, within a transaction; rows that stay as they are, are not written. How many.

    Algorithms know no ids: `keep` says which landmark has that of one before.
    """
    old = _landmark_of_objects(connection, map_id)
    kept = keep(old, [[s.object_id for s in row.sightings] for row in found.landmarks])
    c = landmarks.c
    before = set(connection.execute(select(c.id).where(c.map_id == map_id)).scalars())
    delete_keys(connection, landmarks, c.id, sorted(before - set(kept.ids)))
    names = {name for row in found.landmarks for name in (row.category, *row.perhaps)}
    names |= {item.category for item in found.completed}
    known = _category_ids(connection, sorted(names))
    ids: list[int] = []
    told: list[dict[str, Any]] = []
    for row, key in zip(found.landmarks, kept.ids, strict=True):
        values = {**_values(row), "map_id": map_id, "category_id": known[row.category]}
        if key is None:
            ids.append(new_id(connection, landmarks, values))
        else:
            ids.append(key)
            told.append({**values, "id": key})
    update_rows(connection, landmarks, select(landmarks).where(c.map_id == map_id), told)
    _take_sightings(connection, sorted({s.object_id for row in found.landmarks for s in row.sightings} - old.keys()))
    for table, group, rows in _rows_beside(connection, map_id, found, ids, known):
        stored = select(table).join(landmarks, c.id == table.c.landmark_id).where(c.map_id == map_id)
        write_groups(connection, table, group, stored, rows)
    _keep_merges(connection, map_id, {key: ids[number] for key, number in kept.merged.items()}, set(ids))
    set_gravity(connection, map_id, found.gravity)
    replace_completions(connection, map_id, found.completed, known)
    return len(ids)


def _rows_beside(
    connection: Connection, map_id: int, found: LandmarkSet, ids: Sequence[int], known: Mapping[str, int]
) -> list[tuple[Table, str, list[dict[str, Any]]]]:
    """Tables of what belongs to landmarks, the column by which their rows belong together, and their rows."""
    numbered = list(zip(ids, found.landmarks, strict=True))
    sightings = [
        {"object_id": s.object_id, "landmark_id": key, "coverage": s.coverage, "visibility": s.visibility}
        for key, row in numbered
        for s in row.sightings
    ]
    views = [
        {"landmark_id": key, "place": k, "object_id": v.object_id, "quality": v.quality, "distance": v.distance}
        for key, row in numbered
        for k, v in enumerate(row.views)
    ]
    relations = [
        {
            **{"landmark_id": ids[r.one], "kind": r.kind, "other_landmark_id": ids[r.other], "score": r.score},
            "other_category_id": known[found.landmarks[r.other].category],
            **{"category_id": known[found.landmarks[r.one].category], "map_id": map_id},
        }
        for r in found.relations
    ]
    perhaps = [
        {"landmark_id": key, "category_id": known[name], "map_id": map_id, "probability": share}
        for key, row in numbered
        for name, share in sorted(row.perhaps.items())
    ]
    return [
        (landmark_sightings, "object_id", sightings),
        (landmark_views, "landmark_id", views),
        (landmark_visits, "landmark_id", _visit_rows(connection, map_id, numbered)),
        (landmark_relations, "landmark_id", relations),
        (landmark_categories, "landmark_id", perhaps),
    ]


def _visit_rows(
    connection: Connection, map_id: int, numbered: Sequence[tuple[int, LandmarkRow]]
) -> list[dict[str, Any]]:
    r = recordings.c
    query = select(r.name, r.id).where(r.map_id == map_id)
    known = {str(name): int(key) for name, key in connection.execute(query)}
    none = (None, None, None)
    return [
        {
            "landmark_id": key,
            "recording_id": known[v.recording],
            "presence": v.presence,
            **{name: getattr(v, name) for name in VISIT_COUNTS},
            **dict(zip("xyz", v.position or none, strict=True)),
            **dict(zip(("size_x", "size_y", "size_z"), v.size or none, strict=True)),
        }
        for key, row in numbered
        for v in row.visits
        if v.recording in known  # deleted meanwhile: then the map is of another state, and this is out of date
    ]


def _landmark_of_objects(connection: Connection, map_id: int) -> dict[int, int]:
    s, m = landmark_sightings.c, landmarks.c
    query = select(s.object_id, s.landmark_id).join(landmarks, m.id == s.landmark_id).where(m.map_id == map_id)
    return {int(row.object_id): int(row.landmark_id) for row in connection.execute(query)}


def _take_sightings(connection: Connection, object_ids: Sequence[int]) -> None:
    """Of a recording that was moved here objects are sightings of landmarks of the map that it came from: not any more.

    They are looked for first, since servers lock what is not there when it is deleted, and others wait.
    """
    c, there = landmark_sightings.c, []
    for start in range(0, len(object_ids), CHUNK):
        query = select(c.object_id).where(c.object_id.in_(object_ids[start : start + CHUNK]))
        there += list(connection.execute(query).scalars())
    delete_keys(connection, landmark_sightings, c.object_id, there)


def _category_ids(connection: Connection, names: Sequence[str]) -> dict[str, int]:
    found: dict[str, int] = {}
    for start in range(0, len(names), CHUNK):
        query = select(categories.c.name, categories.c.id).where(categories.c.name.in_(names[start : start + CHUNK]))
        found.update((str(name), int(key)) for name, key in connection.execute(query))
    return found


def _values(row: LandmarkRow) -> dict[str, Any]:
    c = row.covariance
    return {
        "probability": row.probability,
        "evidence": json.dumps(dict(row.evidence), sort_keys=True),
        **dict(zip("xyz", row.position, strict=True)),
        **{f"cov_{a}{b}": float(c["xyz".index(a), "xyz".index(b)]) for a, b in ("xx", "xy", "xz", "yy", "yz", "zz")},
        **{f"size_{axis}": value for axis, value in zip("xyz", row.size, strict=True)},
        "yaw": row.yaw,
        "sightings": len(row.sightings),
        "keyframes": row.keyframes,
        "missed": row.missed,
        "seen_through": row.seen_through,
        "state": row.state,
        "first_keyframe_id": row.first_keyframe_id,
        "last_keyframe_id": row.last_keyframe_id,
        "first_seen_ns": row.first_seen_ns,
        "last_seen_ns": row.last_seen_ns,
        "appearance": None if row.appearance is None else encode_array(row.appearance),
    }


def _keep_merges(connection: Connection, map_id: int, merged: Mapping[int, int], there: set[int]) -> None:
    """Adds what was merged now; what had been merged into one of those follows it."""
    c = landmark_merges.c
    rows = connection.execute(select(c.landmark_id, c.merged_into).where(c.map_id == map_id)).all()
    known = {int(row.landmark_id): int(row.merged_into) for row in rows}
    for key, target in known.items():
        if target in merged:
            change = update(landmark_merges).where(c.landmark_id == key).values(merged_into=merged[target])
            connection.execute(change)
    for key in sorted(there & set(known)):
        connection.execute(delete(landmark_merges).where(c.landmark_id == key))
    new = [{"landmark_id": key, "map_id": map_id, "merged_into": merged[key]} for key in sorted(merged)]
    insert_rows(connection, landmark_merges, [row for row in new if row["landmark_id"] not in known])


def set_gravity(connection: Connection, map_id: int, gravity: GravityRow) -> None:
    """Write which way is up in a map."""
    connection.execute(delete(map_gravity).where(map_gravity.c.map_id == map_id))
    values = {
        **dict(zip(_UP, gravity.up, strict=True)),
        "up_certainty": gravity.up_certainty,
        "floor": gravity.floor,
        "floor_certainty": gravity.floor_certainty,
        "given": int(gravity.given),
    }
    connection.execute(insert(map_gravity), {"map_id": map_id, **values})


def load_gravity(engine: Engine, map_id: int) -> GravityRow | None:
    """Which way is up in a map; None where nobody found out. Raises CodecError for a row that is none."""
    query = select(map_gravity).where(map_gravity.c.map_id == map_id)
    row = retry.read(engine, lambda connection: connection.execute(query).one_or_none())
    if row is None:
        return None
    where = f"of map {map_id}"

    def number(name: str, low: float, high: float) -> float:
        return checked.real(getattr(row, name), f"map_gravity.{name} {where}", low, high)

    x, y, z = (number(name, -1.001, 1.001) for name in _UP)
    if abs(x * x + y * y + z * z - 1) > 1e-3:
        raise CodecError(f"map_gravity {where}: its up is no direction, run semdb refine --force")
    return GravityRow(
        (x, y, z),
        number("up_certainty", 0.0, 1.0),
        None if row.floor is None else number("floor", -1e7, 1e7),
        number("floor_certainty", 0.0, 1.0),
        bool(row.given),
    )


def give_up(engine: Engine, map_id: int, up: Sequence[float] | None) -> None:
    """Note which way is up in a map because somebody knows; None: it is estimated again."""

    def work(connection: Connection) -> None:
        if up is None:
            connection.execute(delete(map_gravity).where(map_gravity.c.map_id == map_id))
        else:
            x, y, z = up
            set_gravity(connection, map_id, GravityRow((x, y, z), 1.0, None, 0.0, given=True))

    retry.write(engine, work)
