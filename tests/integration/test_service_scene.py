"""What viewers draw of a map, through the service: scene, points, crops, what shows what."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.service.settings import ServeSettings
from tests.integration.opened import STRIDE, opener
from tests.serving import Served, running


@pytest.fixture(scope="module")
def served(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A map of six keyframes with landmarks, and an empty one."""
    folder = tmp_path_factory.mktemp("scene")
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        database = opening(detector="auto", encoder="auto", features="auto")
        database.ingest(room, map="office", stride=STRIDE)
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
    assert served.client.get("/v1/maps/empty/landmarks/1/sightings").json() == {"sightings": [], "visits": []}
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
