"""What pages ask the service for: the log with filters, matches, texts about tables, jobs."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.conftest import REPOSITORY
from tests.integration.opened import opener
from tests.serving import Served, form_of, running


@pytest.fixture(scope="module")
def served(office: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A map of six keyframes with landmarks, and a folder to ingest from."""
    folder = tmp_path_factory.mktemp("views")
    shutil.copytree(office, folder, dirs_exist_ok=True)
    (folder / "roots" / "empty folder").mkdir(parents=True)
    (folder / "roots" / "notes.txt").write_text("no recording")
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        database = opening(detector="auto", encoder="auto", features="auto")
        with running(database, ServeSettings(ingest_roots=str(folder / "roots"))) as found:
            yield found


def asked(served: Served, path: str, **parameters: Any) -> Any:
    answer = served.client.get(path, params=parameters or None)
    assert answer.status_code == 200, answer.text
    return answer


def test_the_picture_of_a_map_is_small(served: Served) -> None:
    answer = asked(served, "/v1/maps/office/picture", width=100)
    assert answer.headers["Content-Type"] == "image/jpeg"
    assert cv2.imdecode(np.frombuffer(answer.content, np.uint8), cv2.IMREAD_COLOR).shape[1] == 100
    tag = {"If-None-Match": answer.headers["ETag"]}
    assert served.client.get("/v1/maps/office/picture", params={"width": 100}, headers=tag).status_code == 304
    assert served.client.get("/v1/maps/attic/picture").status_code == 404


def test_matches_come_with_an_answer_that_asks_for_them(served: Served, frames: list[Frame]) -> None:
    form, files = form_of(frames[6], name="folder/matched.png")
    plain = served.client.post("/v1/maps/office/localize", data={**form, "log": "false"}, files=files).json()
    assert "matches" not in plain
    form, files = form_of(frames[6], name="folder/matched.png")
    found = served.client.post("/v1/maps/office/localize", data={**form, "matches": "true"}, files=files).json()
    matches = found["matches"]
    assert found["verdict"] == "localized"
    assert len(matches["query_xy"]) == len(matches["keyframe_xy"]) >= 12
    assert matches["keyframe"] in [one["keyframe"] for one in found["candidates"]]
    whole = served.database.localize(replace(frames[6], depth=None), map="office", log=False)
    assert whole.matches is not None
    assert np.allclose(matches["query_xy"], whole.matches.query_xy, atol=0.006)


def test_the_log_is_filtered_page_by_page(served: Served, frames: list[Frame]) -> None:
    for k in range(3):
        form, files = form_of(frames[4], name=f"shelf/100%_{k}.png")
        served.client.post("/v1/maps/office/localize", data=form, files=files)
    path = "/v1/maps/office/queries"
    mine = asked(served, path, text="100%_", limit=2).json()
    assert [one["image"][-5] for one in mine["items"]] == ["2", "1"]
    assert [one["image"][-5] for one in asked(served, mine["next"]).json()["items"]] == ["0"]
    assert asked(served, path, text="100X_").json()["items"] == []
    assert asked(served, path, text="SHELF/100%").json()["items"] != []
    assert asked(served, path, verdict="failed", text="100%").json()["items"] == []
    now = datetime.now(UTC)
    assert asked(served, path, until=(now - timedelta(hours=1)).isoformat()).json()["items"] == []
    assert len(asked(served, path, since=(now - timedelta(hours=1)).isoformat()).json()["items"]) >= 3
    one = mine["items"][0]
    keyframe = one["candidates"][0]["keyframe"]
    assert one["id"] in [other["id"] for other in asked(served, path, keyframe=keyframe).json()["items"]]
    assert asked(served, path, keyframe=10**12).json()["items"] == []
    assert asked(served, f"/v1/queries/{one['id']}").json() == {"map": "office", **one}
    assert served.client.get("/v1/queries/999999").status_code == 404
    assert served.client.get(path, params={"verdict": "perfect"}).status_code == 422


def test_a_token_that_may_not_see_folders_cannot_ask_for_them(served: Served, frames: list[Frame]) -> None:
    store = served.database._store()
    served.database.localize(replace(frames[4], depth=None), map="office", name="/secret/attic/a.png")
    token = served.database.create_token("read")
    try:
        with served.with_token(token.secret) as client:
            for text, count in (("secret", 0), ("attic/a", 0), ("a.png", 1)):
                found = client.get("/v1/maps/office/queries", params={"text": text}).json()["items"]
                assert len(found) == count, text
    finally:
        from sqlalchemy import text as sql

        with store.engine.begin() as connection:
            connection.execute(sql("DELETE FROM access_tokens"))


def test_texts_of_the_page_are_those_of_the_docs(served: Served) -> None:
    namespace: dict[str, Any] = {"__file__": str(REPOSITORY / "scripts" / "page_texts.py"), "__name__": "texts"}
    exec(compile((REPOSITORY / "scripts" / "page_texts.py").read_text(), "page_texts.py", "exec"), namespace)
    kept = (REPOSITORY / "semdb" / "service" / "page_texts.json").read_text()
    assert kept == namespace["text"](), "run python scripts/page_texts.py"
    found = asked(served, "/v1/tables").json()
    assert set(found["about"]) == set(found["tables"])
    for name, columns in found["tables"].items():
        assert set(columns) == set(found["about"][name]["columns"]), name
    questions = asked(served, "/v1/questions").json()["questions"]
    assert len(questions) > 20
    for question in questions[:6]:
        assert "rows" in asked(served, "/v1/sql", sql=question["sql"]).json()


def test_jobs_are_listed_and_done_again(served: Served, room: Path) -> None:
    sources = asked(served, "/v1/ingest/sources").json()
    assert sources == {
        "paths": True,
        "entries": [
            {"path": "empty folder", "kind": "folder", "bytes": None},
            {"path": "notes.txt", "kind": "file", "bytes": 12},
        ],
        "truncated": False,
    }
    made = served.client.post("/v1/maps/office/ingest", json={"path": "empty folder"}).json()
    deadline = time.monotonic() + 30
    while (job := asked(served, "/v1/jobs").json()["items"][0])["state"] != "failed":
        assert time.monotonic() < deadline, job
        time.sleep(0.05)
    assert job["job"] == made["job"]
    assert job["name"] == "empty folder"
    assert job["error"]
    again = served.client.post(f"/v1/jobs/{made['job']}/retry")
    assert again.status_code == 202, again.text
    assert again.json()["job"] == made["job"] + 1
    assert len(asked(served, "/v1/jobs", map="office", limit=1).json()["items"]) == 1
    assert asked(served, "/v1/jobs", map="elsewhere").json()["items"] == []
    assert served.client.post("/v1/jobs/9999/retry").status_code == 404
    failures = asked(served, "/v1/maps/office/recordings/room/failures").json()
    assert failures == {"map": "office", "recording": "room", "failures": [], "next": None, "key": None}


def test_cameras_that_are_tracked_are_seen_by_those_who_watch(served: Served, frames: list[Frame]) -> None:
    assert asked(served, "/v1/maps/office/live").json() == {"map": "office", "cameras": []}
    assert served.client.get("/v1/maps/attic/live").status_code == 404
    session = served.client.post("/v1/maps/office/sessions", json={}).json()
    poses = []
    with served.client.stream("GET", "/v1/maps/office/live/events") as events:
        lines = events.iter_lines()
        for k in (4, 5):
            form, files = form_of(frames[k], depth=True)
            answer = served.client.post(session["frames"], data=form, files=files).json()
            poses.append(answer["pose"]["position"])
        while True:
            line = next(lines)
            if line.startswith("data: ") and '"frames":2' in line:
                break
    told = json.loads(line[6:])
    assert told["map"] == "office"
    [camera] = asked(served, "/v1/maps/office/live").json()["cameras"]
    assert camera["frames"] == 2
    assert camera["state"] == "tracking"
    assert camera["path"] == told["cameras"][0]["path"] == [[round(value, 4) for value in pose] for pose in poses]
    assert camera["camera"] not in session["session"]
    served.client.delete(session["frames"].removesuffix("/frames"))
    assert asked(served, "/v1/maps/office/live").json()["cameras"] == []
