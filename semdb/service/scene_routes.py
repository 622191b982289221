"""What viewers draw of a map, and what shows what."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Annotated

from fastapi import Query, Request
from starlette.responses import Response

import semdb
from semdb.api import Database
from semdb.database.scene_reading import StoredSighting
from semdb.service import scene_schemas as schemas
from semdb.service import values
from semdb.service.answers import as_json, encoded, has, page_of, tag_of, tagged
from semdb.service.keyframe_routes import keyframe_of
from semdb.service.problems import Problem
from semdb.service.roles import READ
from semdb.service.routing import KeyframeId, Limit, MapName, Table
from semdb.service.state import draw, read, service_of

table = Table("views")
MOST_SIGHTINGS = 1000  # of a page that does not say how many
MOST_KEPT = 4  # scenes, and clouds, in memory
_KEY = re.compile(r"(-?[0-9]{1,19}|)\.([0-9]{1,19})", re.ASCII)
_FILE = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
_clouds: OrderedDict[tuple[str, str, str, int], bytes] = OrderedDict()
_scenes: OrderedDict[tuple[str, str, str, int], bytes] = OrderedDict()
_turn = threading.Lock()


@table.route("GET", "/v1/maps/{map}/scene", READ, schemas.Scene, errors=(304,))
async def get_scene(request: Request, map: MapName) -> Response:
    """All keyframes, landmarks and accepted links of a map, column by column: what a viewer draws."""
    state = await draw(request, lambda db: db.scene_state(map))
    tag = tag_of(f"{semdb.__version__} {service_of(request).database.url} {map} {state}".encode())
    if has(request, tag):
        return tagged(request, b"", "application/json", for_ever=False, tag=tag)

    def look(db: Database) -> tuple[bytes, bool]:
        key = (db.url, map, state, 0)
        return _kept(_scenes, key, lambda: encoded(db.scene(map)), lambda: db.scene_state(map))

    found, is_of_state = await draw(request, look)
    return tagged(request, found, "application/json", for_ever=False, tag=tag if is_of_state else None)


@table.route("GET", "/v1/maps/{map}/points", READ, errors=(304,), only=_FILE)
async def get_points(
    request: Request,
    map: MapName,
    count: Annotated[int, Query(ge=1, le=1_000_000, description="so many at most")] = 100_000,
) -> Response:
    """Coloured points of a map, in an order of which every beginning is spread over all of it.

    Little-endian: uint32 number of points, uint32 keyframes that they are of, float32 lowest x, y, z and step x, y, z
    in metres, then uint16 x, y, z of each point in steps above the lowest, then uint8 red, green, blue of each.
    """
    found = await draw(request, lambda db: _points(db, map, count))
    return tagged(request, found, "application/octet-stream", for_ever=False)


def _points(db: Database, map_name: str, count: int) -> bytes:
    key = (db.url, map_name, db.map_state(map_name), count)
    return _kept(_clouds, key, lambda: db.cloud(map_name, count).packed(), lambda: db.map_state(map_name))[0]


def _kept(
    where: OrderedDict[tuple[str, str, str, int], bytes],
    key: tuple[str, str, str, int],
    make: Callable[[], bytes],
    state: Callable[[], str],
) -> tuple[bytes, bool]:
    """What was made for that key, or is made now; only the last few are kept.

    And whether it is of the state in the key: what is made while the map changes is not, and the map may come back to
    that state.
    """
    with _turn:
        if key in where:
            where.move_to_end(key)
            return where[key], True
    made = make()
    if state() != key[2]:
        return made, False
    with _turn:
        where[key] = made
        while len(where) > MOST_KEPT:
            where.popitem(last=False)
    return made, True


@table.route("GET", "/v1/maps/{map}/landmarks/{landmark}/sightings", READ, schemas.LandmarkHistory)
async def list_sightings(
    request: Request,
    map: MapName,
    landmark: KeyframeId,
    after: Annotated[str | None, Query(max_length=50, description="key of an earlier page")] = None,
    limit: Limit = None,
) -> Response:
    """The objects of keyframes that show a landmark, by time, and what each recording says of it."""
    last = None if after is None else _moment_key(after)
    found, visits = await read(request, lambda db: (db.sightings(map, landmark), db.visits(map, landmark)))
    later = [one for one in found if last is None or _moment(one) > last]
    most = limit or MOST_SIGHTINGS
    return page_of(
        *(request, later[: most + 1], most),
        lambda one: f"{'' if one.timestamp_ns is None else one.timestamp_ns}.{one.object_id}",
        values.sighting_dict,
        under="sightings",
        also={"visits": [values.visit_dict(one) for one in visits]},
    )


def _moment(found: StoredSighting) -> tuple[bool, int, int]:
    """By what sightings are in order: those without a time come first."""
    return found.timestamp_ns is not None, found.timestamp_ns or 0, found.object_id


def _moment_key(text: str) -> tuple[bool, int, int]:
    """A time, or none, and the id of an object. Raises Problem 422."""
    found = _KEY.fullmatch(text)
    if found is None:
        raise Problem(422, "after is no key of an earlier page")
    return found[1] != "", int(found[1] or 0), int(found[2])


@table.route("GET", "/v1/keyframes/{keyframe}/landmarks", READ, schemas.Sightings)
async def list_seen_landmarks(request: Request, keyframe: KeyframeId) -> Response:
    """The landmarks that a keyframe shows, with the objects that show them."""
    await keyframe_of(request, keyframe)
    found = await read(request, lambda db: db.seen_in(keyframe))
    return as_json({"sightings": [values.sighting_dict(one) for one in found]})
