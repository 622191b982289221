"""What viewers draw of a map, through the service: scene, points, crops, what shows what."""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sqlalchemy import delete, update

import semdb
from semdb.database import landmark_tables, tables
from semdb.database.query_log import QueryFilter
from semdb.database.scene_reading import scene_state
from semdb.database.store import Store
from semdb.errors import NotFoundError, UsageError
from semdb.pictures.cloud import STEPS
from semdb.service.settings import ServeSettings
from tests.database_samples import fill, stored_landmarks
from tests.integration.opened import opener
from tests.serving import Served, running


@pytest.fixture(scope="module")
def served(office: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A map of six keyframes with landmarks, and an empty one."""
    folder = tmp_path_factory.mktemp("scene")
    shutil.copytree(office, folder, dirs_exist_ok=True)
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        database = opening(detector="auto", encoder="auto", features="auto")
        database.refine("office", steps=["landmarks"])
        database._store().ensure_map("empty")
        with running(database, ServeSettings()) as found:
            yield found


def test_the_scene_has_every_keyframe_and_landmark(served: Served) -> None:
    answer = served.client.get("/v1/maps/office/scene")
    scene = answer.json()
    keyframes = served.database.keyframes("office")
    assert scene["keyframes"]["id"] == [one.id for one in keyframes]
    assert scene["keyframes"]["recordings"] == [keyframes[0].recording]
    assert scene["keyframes"]["camera"] == [0] * len(keyframes)
    positions = np.array(scene["keyframes"]["position"]).reshape(-1, 3)
    np.testing.assert_allclose(positions, [one.world_from_camera[:3, 3] for one in keyframes], atol=1e-4)
    landmarks = served.database.landmarks("office")
    columns = scene["landmarks"]
    assert len(landmarks) > 3
    assert columns["id"] == [one.id for one in landmarks]
    assert [columns["categories"][place] for place in columns["category"]] == [one.category for one in landmarks]
    assert len(columns["covariance"]) == 6 * len(landmarks)
    again = served.client.get("/v1/maps/office/scene", headers={"If-None-Match": answer.headers["ETag"]})
    assert again.status_code == 304
    empty = served.client.get("/v1/maps/empty/scene").json()
    assert (empty["keyframes"]["id"], empty["landmarks"]["id"], empty["links"]["kind"]) == ([], [], [])
    assert served.client.get("/v1/maps/attic/scene").status_code == 404


def test_points_are_where_landmarks_are(served: Served) -> None:
    answer = served.client.get("/v1/maps/office/points", params={"count": 3000})
    count, keyframes = np.frombuffer(answer.content, "<u4", 2)
    assert 1000 < count <= 3000
    assert keyframes == len(served.database.keyframes("office"))
    assert len(answer.content) == 32 + 9 * count
    low, step = np.frombuffer(answer.content, "<f4", 6, 8).reshape(2, 3)
    points = low + step * np.frombuffer(answer.content, "<u2", 3 * count, 32).reshape(-1, 3)
    for thing in served.database.landmarks("office"):
        assert np.linalg.norm(points - thing.position, axis=1).min() < 0.4
    again = served.client.get("/v1/maps/office/points", params={"count": 3000})
    assert again.content == answer.content
    assert len(served.client.get("/v1/maps/empty/points").content) == 32
    for bad in (0, 10_000_000, "x"):
        assert served.client.get("/v1/maps/office/points", params={"count": bad}).status_code == 422


def test_sightings_go_both_ways(served: Served) -> None:
    thing = max(served.database.landmarks("office"), key=lambda one: one.sightings)
    found = served.client.get(f"/v1/maps/office/landmarks/{thing.id}/sightings").json()
    assert len(found["sightings"]) == thing.sightings
    assert {one["presence"] for one in found["visits"]} == {"present"}
    one = found["sightings"][0]
    back = served.client.get(f"/v1/keyframes/{one['keyframe']}/landmarks").json()["sightings"]
    assert one in back
    objects = served.client.get(f"/v1/keyframes/{one['keyframe']}/objects").json()["objects"]
    assert objects[one["ordinal"]]["box"] == pytest.approx(one["box"])
    nothing = {"sightings": [], "visits": [], "next": None, "key": None}
    assert served.client.get("/v1/maps/empty/landmarks/1/sightings").json() == nothing
    assert served.client.get("/v1/keyframes/999999/landmarks").status_code == 404


def test_images_come_smaller_and_in_part(served: Served) -> None:
    keyframe = served.database.keyframes("office")[0]

    def size(**parameters: object) -> tuple[int, int]:
        answer = served.client.get(f"/v1/keyframes/{keyframe.id}/image", params=parameters)
        assert answer.headers["Content-Type"] == "image/jpeg"
        image = cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR)
        return image.shape[1], image.shape[0]

    width, height = keyframe.camera.width, keyframe.camera.height
    assert size(width=100) == (100, round(100 * height / width))
    assert size(box="10,20,49,39") == (40, 20)
    assert size(box="-50,-50,9999,9999", width=80)[0] == 80
    for bad in ({"box": "1,2,3"}, {"box": "nan,1,2,3"}, {"box": "9000,1,9010,3"}, {"width": 1}, {"box": "x"}):
        assert served.client.get(f"/v1/keyframes/{keyframe.id}/image", params=bad).status_code == 422, bad


def plain(value: Any) -> Any:
    """A value of the library as something that can be compared, arrays with their bits."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return type(value), [plain(one) for one in value]
    if isinstance(value, float):
        return repr(value)  # NaN is like NaN
    if hasattr(value, "__dataclass_fields__"):
        return type(value), {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value


def test_clients_get_the_values_of_the_library(served: Served) -> None:
    own = served.database
    keyframe = own.keyframes("office")[1]
    own.localize(keyframe.image, map="office", camera=keyframe.camera, name="folder/one")
    thing = max(own.landmarks("office"), key=lambda one: one.sightings)
    related = own.relations("office")[0]
    job = own.add_job("office", "loopback", {"path": "/somewhere/kitchen"})
    last = own.queries("office")[0]
    wanted = QueryFilter(verdict="localized", until=datetime(2100, 1, 1))
    asked: list[Callable[[Any], Any]] = [
        lambda db: db.landmarks("office"),
        lambda db: db.landmarks("office", category=thing.category, state=thing.state, after=1, limit=2),
        lambda db: db.relations("office"),
        lambda db: db.relations("office", landmark=related.landmark_id, kind=related.kind, limit=1),
        lambda db: db.relations(
            "office", after=(related.landmark_id, related.other_landmark_id, related.kind), limit=2
        ),
        lambda db: (db.up("office"), db.up("empty")),
        lambda db: (db.coverage("office"), db.coverage("empty"), db.coverage("office", (0, 0, 1), radius_m=1.5)),
        lambda db: (db.sightings("office", thing.id), db.visits("office", thing.id), db.seen_in(keyframe.id)),
        lambda db: (db.keyframe_files(keyframe.id), db.loops(odometry=True), db.loops("office", limit=3)),
        lambda db: (db.has_recording("room"), db.has_recording("room", "empty"), db.has_recording("attic")),
        lambda db: (db.queries("office", before=last.id + 1, limit=1), db.query(last.id)),
        lambda db: (db.queries("office", wanted=wanted), db.queries("office", wanted=QueryFilter(text="dark"))),
        lambda db: db.queries("office"),
        lambda db: (db.failures("room", "office"), db.check_keyframes([keyframe.id]), db.scene("office")),
    ]
    with semdb.connect(served.url) as db:
        for ask in asked:
            assert plain(ask(db)) == plain(ask(own))
        assert len(db.landmarks("office")) > 3
        assert len(db.queries("office", wanted=wanted)) == 1
        while own.job(job).state != "failed":  # there is no such folder
            time.sleep(0.05)
        found = db.job(job)
        assert plain(replace(own.job(job), request={"name": "kitchen"}, who="")) == plain(found)
        assert [one.id for one in db.jobs("office", limit=1)] == [job]
        cloud, exact = db.cloud("office", 2000), own.cloud("office", 2000)
        assert np.array_equal(cloud.colours, exact.colours)
        span = np.ptp(exact.points, axis=0)
        assert np.all(np.abs(cloud.points - exact.points) <= span / STEPS)  # half a step, and rounding
        missing: list[Callable[[Any], Any]] = [
            lambda db: db.landmarks("attic"),
            lambda db: db.up("attic"),
            lambda db: db.queries("attic"),
            lambda db: db.has_recording("room", "attic"),
            lambda db: db.failures("attic", "office"),
            lambda db: db.check_keyframes([keyframe.id, 10**9]),
            lambda db: db.keyframe_files(10**9),
            lambda db: db.query(0),
            lambda db: db.job(10**9),
        ]
        for ask in missing:
            with pytest.raises(NotFoundError):
                ask(own)
            with pytest.raises(NotFoundError):
                ask(db)
        for ask in (lambda db: db.coverage("office", (0, 0)), lambda db: db.queries("office", limit=0)):
            with pytest.raises(UsageError):
                ask(db)

        async def all_of_it() -> None:
            async with db.aio as later:
                assert plain(await later.landmarks("office", limit=2)) == plain(own.landmarks("office", limit=2))
                assert plain(await later.coverage("office", (0, 0, 1))) == plain(own.coverage("office", (0, 0, 1)))
                assert plain(await later.query(last.id)) == plain(own.query(last.id))

        asyncio.run(all_of_it())


def test_asyncio_has_every_method() -> None:
    def methods(kind: type) -> set[str]:
        return {name for name in dir(kind) if not name.startswith("_")}

    only_here = {"refine", "trajectory", "align", "undo_align", "aio"}
    assert methods(semdb.RemoteDatabase) - methods(semdb.AsyncDatabase) == only_here
    assert {name for name in vars(semdb.SemanticDatabase) if not name.startswith("_")} <= methods(semdb.RemoteDatabase)


def test_a_scene_that_did_not_change_is_not_made_again(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    answer = served.client.get("/v1/maps/office/scene")
    monkeypatch.setattr(type(served.database), "scene", lambda *_: pytest.fail("the scene is made"))
    again = served.client.get("/v1/maps/office/scene", headers={"If-None-Match": answer.headers["ETag"]})
    assert (again.status_code, again.content, again.headers["ETag"]) == (304, b"", answer.headers["ETag"])
    kept = served.client.get("/v1/maps/office/scene", headers={"If-None-Match": '"another"'})
    assert (kept.status_code, kept.content) == (200, answer.content)
    monkeypatch.undo()
    served.database.tell_up("office", (0.0, 0.6, 0.8))
    other = served.client.get("/v1/maps/office/scene", headers={"If-None-Match": answer.headers["ETag"]})
    assert (other.status_code, other.json()["up"]) == (200, [0.0, 0.6, 0.8])


def test_a_scene_that_changes_while_it_is_made_is_not_kept(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    database, kind = served.database, type(served.database)
    database.tell_up("office", (0.0, 0.8, 0.6))
    before, scene = database.scene_state("office"), kind.scene

    def turned(self: Any, name: str) -> Any:
        self.tell_up(name, (0.6, 0.0, 0.8))
        return scene(self, name)

    monkeypatch.setattr(kind, "scene", turned)
    mixed = served.client.get("/v1/maps/office/scene")
    assert mixed.json()["up"] == [0.6, 0.0, 0.8]
    monkeypatch.undo()
    database.tell_up("office", (0.0, 0.8, 0.6))
    again = served.client.get("/v1/maps/office/scene", headers={"If-None-Match": mixed.headers["ETag"]})
    assert (again.status_code, again.json()["up"]) == (200, [0.0, 0.8, 0.6])
    assert database.scene_state("office") == before


def test_the_state_of_a_scene_follows_all_that_it_shows(store: Store) -> None:
    map_id, _, keyframes = fill(store)
    stored_landmarks(store, map_id)
    states = [scene_state(store.engine, map_id)]
    assert scene_state(store.engine, map_id) == states[0]
    changes = [
        update(landmark_tables.landmarks).where(landmark_tables.landmarks.c.id == 1).values(yaw=0.2),
        update(landmark_tables.landmarks).where(landmark_tables.landmarks.c.id == 1).values(state="gone"),
        update(landmark_tables.map_gravity).values(up_x=0.6, up_z=0.8),
        update(tables.keyframes).where(tables.keyframes.c.id == keyframes[0]).values(tx=0.5),
        delete(landmark_tables.landmarks).where(landmark_tables.landmarks.c.id == 2),
    ]
    for statement in changes:
        with store.engine.begin() as connection:
            connection.execute(statement)
        states.append(scene_state(store.engine, map_id))
    fill(store, "another")
    assert scene_state(store.engine, map_id) == states[-1]
    assert len(set(states)) == len(states)


def test_the_document_names_all_that_is_answered(served: Served) -> None:
    document = served.api.openapi()
    keyframe = served.database.keyframes("office")[0].id
    photo = served.client.get(f"/v1/keyframes/{keyframe}/image").content
    form = {"matches": "true", "masks": "true"}
    answer = served.client.post("/v1/maps/office/localize", data=form, files={"image": photo}).json()
    session = served.client.post("/v1/maps/office/sessions", json={}).json()
    tracked = served.client.post(session["frames"], files={"image": photo}).json()
    thing = max(served.database.landmarks("office"), key=lambda one: one.sightings).id
    job = served.database.add_job("office", "loopback", {"path": "/somewhere/kitchen"})
    query = served.database.queries("office")[0].id
    in_address = {"map": "office", "recording": "room", "keyframe": keyframe, "landmark": thing, "job": job}
    asked = {"what": "chair", "before": "room", "after": "room", "sql": "SELECT 1", "odometry": "true", "masks": "true"}

    def unnamed(value: Any, schema: Any, where: str) -> Iterator[str]:
        schema = document["components"]["schemas"].get(schema.get("$ref", "").rpartition("/")[2], schema)
        if "anyOf" in schema:
            yield from unnamed(value, schema["anyOf"][0], where)
        elif isinstance(value, dict):
            for name, inner in value.items() if "properties" in schema else ():
                if name in schema["properties"]:
                    yield from unnamed(inner, schema["properties"][name], f"{where}.{name}")
                else:
                    yield f"{where}.{name}"
        elif isinstance(value, list) and "items" in schema:
            for inner in value[:3]:
                yield from unnamed(inner, schema["items"], where)

    def schema_of(operation: Any, status: str) -> Any:
        return operation["responses"][status]["content"].get("application/json", {}).get("schema", {})

    paths = document["paths"]
    found = [
        *unnamed(answer, schema_of(paths["/v1/maps/{map}/localize"]["post"], "200"), "answer"),
        *unnamed(session, schema_of(paths["/v1/maps/{map}/sessions"]["post"], "201"), "session"),
        *unnamed(tracked, schema_of(paths["/v1/sessions/{session}/frames"]["post"], "200"), "tracked"),
    ]
    looked = 0
    for path, operations in paths.items():
        schema = schema_of(operations["get"], "200") if "get" in operations else {}
        if schema:
            known = {one["name"] for one in operations["get"].get("parameters", [])}
            known -= set() if "changes" in path else {"before", "after"}  # elsewhere they are keys
            given = {name: value for name, value in asked.items() if name in known}
            told = served.client.get(path.format(**in_address, query=query), params=given)
            if told.status_code == 200:
                looked += 1
                found += unnamed(told.json(), schema, path)
    assert (found, looked > 25) == ([], True), looked
