"""Maps, recordings, and what is known of a map."""

from __future__ import annotations

import re
from typing import Annotated, Any

from fastapi import Query, Request
from starlette.responses import Response

from semdb.api import Database
from semdb.service import schemas, values
from semdb.service.answers import as_json, page_of, tagged
from semdb.service.pictures import small
from semdb.service.problems import Problem, not_found
from semdb.service.roles import ADMIN, READ
from semdb.service.routing import AfterId, KeyframeId, Limit, MapName, Table
from semdb.service.state import access_of, draw, read, service_of

table = Table("maps")
_PICTURE = {"image/jpeg": {"schema": {"type": "string", "format": "binary"}}}
_PAIR = re.compile(r"[0-9]{1,19}-[0-9]{1,19}-[a-z_]{1,16}")
Coordinate = Annotated[float | None, Query(ge=-1e7, le=1e7, allow_inf_nan=False, description="metres")]


@table.route("GET", "/v1/maps", READ, schemas.Page[schemas.Map])
async def list_maps(request: Request, after: AfterId = 0, limit: Limit = None) -> Response:
    """The maps that the token may see, by id."""
    most, access = limit or service_of(request).settings.page, access_of(request)
    found = await read(request, lambda db: db.maps())
    seen = [info for info in found if access.sees(info.name) and info.id > after]
    return page_of(request, seen[: most + 1], most, lambda info: info.id, values.map_dict)


@table.route("GET", "/v1/maps/{map}", READ, schemas.MapDetail)
async def get_map(request: Request, map: MapName) -> Response:
    """A map: how it is described, what was refined, which way is up."""

    def look(db: Database) -> dict[str, Any]:
        info = db.map(map)
        steps = [step for step in db.status(map).refinements if step.map_id == info.id]
        up = db.up(map)
        return values.map_dict(info) | {
            "models": [values.model_dict(model) for model in db.models(map)],
            "refinements": [
                {"kind": s.kind, "current": s.current, "computed_at": f"{s.computed_at.isoformat()}Z", "rows": s.rows}
                for s in steps
            ],
            "up": None if up is None else list(up),
        }

    return as_json(await read(request, look))


@table.route("GET", "/v1/recordings", READ, schemas.Page[schemas.Recording], errors=(404,))
async def list_recordings(
    request: Request,
    map: Annotated[str | None, Query(max_length=255, description="only of this map")] = None,
    after: AfterId = 0,
    limit: Limit = None,
) -> Response:
    """The recordings of a map, or of all that the token may see, with what is planned and stored, by id."""
    most, access = limit or service_of(request).settings.page, access_of(request)
    if map is not None and not access.sees(map):
        raise Problem(403, f"this token is not for the map {map!r}")
    wanted = map if map is not None else access.map
    found = await read(request, lambda db: db.recordings(wanted))
    later = sorted((one for one in found if one.recording_id > after), key=lambda one: one.recording_id)
    with_source = access.has(ADMIN)
    return page_of(
        *(request, later[: most + 1], most),
        lambda one: one.recording_id,
        lambda one: values.recording_dict(one, with_source=with_source),
    )


@table.route("GET", "/v1/maps/{map}/recordings/{recording}", READ, schemas.Recording)
async def get_recording(request: Request, map: MapName, recording: str) -> Response:
    """A recording of a map."""
    found = await read(request, lambda db: db.recording(recording, map))
    return as_json(values.recording_dict(found, with_source=access_of(request).has(ADMIN)))


@table.route("GET", "/v1/maps/{map}/keyframes", READ, schemas.Page[schemas.Keyframe])
async def list_keyframes(
    request: Request,
    map: MapName,
    recording: Annotated[str | None, Query(max_length=255, description="only of this recording")] = None,
    after: AfterId = 0,
    limit: Limit = None,
) -> Response:
    """The keyframes of a map, or of a recording of it, by id."""
    most = limit or service_of(request).settings.page
    found = await read(request, lambda db: db.keyframes(map, recording, after=after, limit=most + 1))
    return page_of(request, found, most, lambda one: one.id, values.keyframe_dict)


@table.route("GET", "/v1/maps/{map}/landmarks", READ, schemas.Page[schemas.Landmark])
async def list_landmarks(
    request: Request,
    map: MapName,
    category: Annotated[str | None, Query(max_length=255, description="only of this class")] = None,
    state: Annotated[str | None, Query(max_length=16, description="tentative, confirmed or gone")] = None,
    after: AfterId = 0,
    limit: Limit = None,
) -> Response:
    """The landmarks of a map by id: things that several keyframes see. `semdb refine` computes them."""
    most = limit or service_of(request).settings.page
    found = await read(
        request, lambda db: db.landmarks(map, category=category, state=state, after=after, limit=most + 1)
    )
    return page_of(request, found, most, lambda one: one.id, lambda one: values.landmark_dict(one, map))


@table.route("GET", "/v1/maps/{map}/landmarks/{landmark}", READ, schemas.Landmark)
async def get_landmark(request: Request, map: MapName, landmark: KeyframeId) -> Response:
    """A landmark, and how it stands to others."""

    def look(db: Database) -> dict[str, Any]:
        found = db.landmarks(map, after=landmark - 1, limit=1)
        if not found or found[0].id != landmark:
            raise not_found(f"landmark {landmark} in the map {map!r}")
        related = db.relations(map, landmark=landmark)
        shown = [values.relation_dict(one) for one in related]
        return values.landmark_dict(found[0], map) | {"relations": shown}

    return as_json(await read(request, look))


@table.route("GET", "/v1/maps/{map}/relations", READ, schemas.Page[schemas.Relation])
async def list_relations(
    request: Request,
    map: MapName,
    kind: Annotated[str | None, Query(max_length=32, description="only of this kind: on, near, ...")] = None,
    landmark: Annotated[int | None, Query(ge=1, le=2**63 - 1, description="only of this landmark to others")] = None,
    after: Annotated[str | None, Query(max_length=100, description="key of an earlier page")] = None,
    limit: Limit = None,
) -> Response:
    """How the landmarks of a map stand to each other, by ids."""
    most, last = limit or service_of(request).settings.page, _pair_key(after)
    found = await read(request, lambda db: db.relations(map, kind=kind, landmark=landmark, after=last, limit=most + 1))
    return page_of(
        *(request, found, most),
        lambda one: f"{one.landmark_id}-{one.other_landmark_id}-{one.kind}",
        values.relation_dict,
    )


def _pair_key(after: str | None) -> tuple[int, int, str] | None:
    """Two ids and a kind. Raises Problem 422."""
    if after is None:
        return None
    first, _, rest = after.partition("-")
    second, _, kind = rest.partition("-")
    if not _PAIR.fullmatch(after) or max(int(first), int(second)) >= 2**63:
        raise Problem(422, "after is no key of an earlier page")
    return int(first), int(second), kind


@table.route("GET", "/v1/find", READ, schemas.Found, errors=(404,))
async def find(
    request: Request,
    what: Annotated[str, Query(min_length=1, max_length=255, description="a class, or a word for one")],
    near: Annotated[str | None, Query(min_length=1, max_length=255)] = None,
    on: Annotated[str | None, Query(min_length=1, max_length=255)] = None,
    not_near: Annotated[str | None, Query(min_length=1, max_length=255)] = None,
    map: Annotated[str | None, Query(max_length=255, description="only in this map")] = None,
    seen_after: Annotated[str | None, Query(max_length=255, description="a time, or a recording")] = None,
    x: Coordinate = None,
    y: Coordinate = None,
    z: Coordinate = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 10,
) -> Response:
    """Where things are: landmarks of a class or word, the best first; `x`, `y`, `z`: the nearer to there the better."""
    access = access_of(request)
    if map is not None and not access.sees(map):
        raise Problem(403, f"this token is not for the map {map!r}")
    where, origin = map if map is not None else access.map, place(x, y, z)
    found = await read(
        request,
        lambda db: values.found_dict(
            db.find(
                what, near=near, on=on, not_near=not_near, map=where, seen_after=seen_after, origin=origin, limit=limit
            )
        ),
    )
    return as_json(found)


def place(x: float | None, y: float | None, z: float | None) -> tuple[float, float, float] | None:
    """A place, or none. Raises Problem 422 for a part of one."""
    if x is None and y is None and z is None:
        return None
    if x is None or y is None or z is None:
        raise Problem(422, "a place is x, y and z: give all of them, or none")
    return x, y, z


@table.route("GET", "/v1/maps/{map}/changes", READ, schemas.ChangesModel)
async def get_changes(
    request: Request,
    map: MapName,
    before: Annotated[str, Query(min_length=1, max_length=255, description="a recording", examples=["monday"])],
    after: Annotated[str, Query(min_length=1, max_length=255, description="a later one", examples=["friday"])],
) -> Response:
    """What appeared, disappeared and moved from one recording of a map to another one."""
    return as_json((await read(request, lambda db: db.changes(before, after, map))).as_dict())


@table.route("GET", "/v1/maps/{map}/loops", READ, schemas.Page[schemas.Link])
async def list_loops(
    request: Request,
    map: MapName,
    odometry: Annotated[bool, Query(description="also what follows each other")] = False,
    after: Annotated[str | None, Query(max_length=100, description="key of an earlier page")] = None,
    limit: Limit = None,
) -> Response:
    """What ties keyframes of a map together, by ids."""
    most, last = limit or service_of(request).settings.page, _pair_key(after)
    found = await read(request, lambda db: db.loops(map, odometry=odometry, after=last, limit=most + 1))
    return page_of(
        *(request, found, most), lambda one: f"{one.keyframe}-{one.other_keyframe}-{one.kind}", values.link_dict
    )


@table.route("GET", "/v1/maps/{map}/coverage", READ, schemas.CoverageModel)
async def get_coverage(
    request: Request,
    map: MapName,
    x: Coordinate = None,
    y: Coordinate = None,
    z: Coordinate = None,
    radius: Annotated[float, Query(gt=0, le=1e4, description="metres")] = 2.0,
) -> Response:
    """How many keyframes are near a place, or at all, and where they look: whether localizing there can be expected."""
    where = place(x, y, z)
    return as_json((await read(request, lambda db: db.coverage(map, where, radius_m=radius))).as_dict())


@table.route("GET", "/v1/maps/{map}/picture", READ, errors=(304,), only=_PICTURE)
async def get_map_picture(
    request: Request,
    map: MapName,
    width: Annotated[int, Query(ge=16, le=4096, description="pixels, at most")] = 480,
) -> Response:
    """A small picture of a map: the keyframe of it that shows most classes. 404 where it has no keyframe."""

    def look(db: Database) -> bytes | None:
        key = db.title_keyframe(map)
        return None if key is None else small(db.keyframe_files(key).rgb, f"keyframe {key}", width)

    found = await draw(request, look)
    if found is None:
        raise not_found(f"picture of the map {map!r}: it has no keyframe")
    return tagged(request, found, "image/jpeg", for_ever=False)
