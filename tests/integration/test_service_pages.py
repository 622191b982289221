"""Lists of the service come page by page from the database, each row once and in one order, on every server."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import semdb
from semdb.database.store import Store
from semdb.service.settings import ServeSettings
from tests.database_samples import fill, stored_landmarks
from tests.pose_samples import fill_estimated
from tests.serving import Served, running

PATHS = (
    "/v1/maps/estimated/loops?odometry=true",
    "/v1/maps/room/landmarks",
    "/v1/maps/room/landmarks?category=cup&state=confirmed",
    "/v1/maps/room/relations",
    "/v1/maps/room/relations?kind=on",
    "/v1/maps/estimated/keyframes",
)


def pages(served: Served, path: str, limit: int, under: str = "items") -> list[Any]:
    """All items of a list, `limit` at a time."""
    address: str | None = f"{path}{'&' if '?' in path else '?'}limit={limit}"
    found = []
    while address:
        answer = served.client.get(address)
        assert answer.status_code == 200, answer.text
        assert len(answer.json()[under]) <= limit
        found += answer.json()[under]
        address = answer.json()["next"]
    return found


def test_lists_come_page_by_page(
    database_url: str, store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, _, ids = fill_estimated(store)
    map_id, _, _ = fill(store)
    things = stored_landmarks(store, map_id)
    with running(semdb.open(database_url, cache_dir=tmp_path), ServeSettings(rate=0)) as served:
        for path in PATHS:
            whole = pages(served, path, 1000)
            assert len(whole) > 1, path
            for limit in (1, 2, len(whole) - 1, len(whole)):
                assert pages(served, path, limit) == whole, (path, limit)
        with store.engine.begin() as connection:
            connection.exec_driver_sql("UPDATE ingest_items SET state = 'failed', error = 'no light'")
        name = store.status(map_id)[0].name.replace(" ", "%20")
        for path, under in (
            (f"/v1/maps/room/landmarks/{things[0]}/sightings", "sightings"),
            (f"/v1/maps/room/recordings/{name}/failures", "failures"),
        ):
            whole = pages(served, path, 1000, under)
            assert len(whole) > 2, path
            for limit in (1, 2, len(whole)):
                assert pages(served, path, limit, under) == whole, (path, limit)
            assert served.client.get(path, params={"after": "'; DROP"}).status_code == 422
        assert len(served.client.get(f"/v1/maps/room/landmarks/{things[0]}/sightings?limit=1").json()["visits"]) == 1
        links = pages(served, PATHS[0], 1)
        assert [(one["keyframe"], one["other_keyframe"]) for one in links] == [
            *(
                (ids[0], ids[1]),
                (ids[0], ids[4]),
                (ids[1], ids[2]),
                (ids[1], ids[4]),
                (ids[2], ids[3]),
                (ids[3], ids[4]),
            )
        ]
        assert [one["id"] for one in pages(served, PATHS[1], 3)] == things
        one = served.client.get(f"/v1/maps/room/landmarks/{things[0]}").json()
        assert {(r["landmark"], r["kind"]) for r in one["relations"]} >= {(things[1], "on"), (things[2], "next_to")}
        assert served.client.get(f"/v1/maps/room/landmarks/{things[-1] + 1}").status_code == 404
        for key in ("1", "1-2", "x-y-on", f"{2**63}-1-on", "1-2-on' OR 1=1"):
            for path in ("/v1/maps/room/relations", "/v1/maps/estimated/loops"):
                assert served.client.get(path, params={"after": key}).status_code == 422, key
        damaged = f"UPDATE loop_closures SET state = 'odd' WHERE keyframe_id IN ({ids[0]}, {ids[2]})"
        with store.engine.begin() as connection:
            connection.exec_driver_sql(damaged)
        for limit in (1, 2, 10):  # what is left out ends no list
            found = pages(served, PATHS[0], limit)
            assert [one["keyframe"] for one in found] == [ids[1], ids[1], ids[3]], limit
