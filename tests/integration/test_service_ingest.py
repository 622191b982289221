"""Recordings that become part of a map over HTTP: by path, uploaded, frame by frame."""

from __future__ import annotations

import io
import json
import os
import stat
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import semdb
from semdb.database.jobs import FAILED, MOST_ATTEMPTS
from semdb.errors import LeaseLostError, NotFoundError
from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.integration.opened import opener
from tests.serving import Served, png, running


@pytest.fixture(scope="module")
def served(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service on an empty file, which may ingest what lies beside the room."""
    folder = tmp_path_factory.mktemp("ingesting")
    url = f"sqlite:///{folder / 'a.sqlite3'}"
    settings = ServeSettings(ingest_roots=str(room.parent), max_recording_mb=20.0, max_unpacked_mb=40.0)
    with opener(url, folder / "cache") as opening, semdb.open(url) as made:
        made.init()
        with running(opening(), settings) as found:
            yield found


def ended(served: Served, job: dict[str, Any], client: Any = None) -> dict[str, Any]:
    """A job when it is done or failed."""
    for _ in range(600):
        found: dict[str, Any] = (client or served.client).get(job["address"]).json()
        if found["state"] in ("done", "failed"):
            return found
        time.sleep(0.1)
    raise AssertionError(found)


def test_a_recording_by_its_path_and_its_job_as_events(served: Served, room: Path) -> None:
    asked = served.client.post("/v1/maps/office/ingest", json={"path": "room", "stride": 12, "name": "first"})
    assert asked.status_code == 202, asked.text
    job = asked.json()
    with served.client.stream("GET", f"{job['address']}/events") as stream:
        assert stream.headers["content-type"].startswith("text/event-stream")
        told = [line for line in stream.iter_lines() if line.startswith(("event", "data"))]
    assert told[-2] == "event: end"
    last = json.loads(told[-1].removeprefix("data: "))
    assert (last["state"], last["items"], last["error"]) == ("done", {"done": 2}, None)
    assert served.database.map("office").keyframes == 2
    again = served.client.post("/v1/maps/office/ingest", json={"path": str(room), "stride": 12, "name": "first"})
    assert ended(served, again.json())["state"] == "done"
    assert served.database.map("office").keyframes == 2


def test_a_path_is_below_a_root(served: Served, room: Path, tmp_path: Path) -> None:
    (tmp_path / "outside").mkdir()
    link = room.parent / "link"
    link.symlink_to(tmp_path / "outside")
    try:
        for path in (
            "/etc",
            "../..",
            "room/../../..",
            "link",
            str(tmp_path),
            "file:///etc",
            "s3://b/x",
            "room\0",
            "attic",
        ):
            answer = served.client.post("/v1/maps/office/ingest", json={"path": path})
            assert answer.status_code == 422, (path, answer.text)
            assert "no such recording" in answer.text or "path of a folder" in answer.text
    finally:
        link.unlink()
    for body in (
        {},
        {"path": "room", "upload": "x"},
        {"path": "room", "unknown": 1},
        {"path": "room", "camera": "1,2"},
    ):
        assert served.client.post("/v1/maps/office/ingest", json=body).status_code == 422, body
    assert served.client.post("/v1/maps/office/ingest", json={"upload": "../../etc"}).status_code == 404


def zipped(entries: dict[str, bytes], *, link: str | None = None) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
        if link is not None:
            info = zipfile.ZipInfo("room/link")
            info.external_attr = (stat.S_IFLNK | 0o777) << 16
            archive.writestr(info, link)
    return made.getvalue()


def test_a_zip_is_unpacked_and_ingested(served: Served, room: Path) -> None:
    entries = {f"room/{path.relative_to(room)}": path.read_bytes() for path in room.rglob("*") if path.is_file()}
    sent = served.client.post("/v1/uploads", params={"name": "room.zip"}, content=zipped(entries))
    assert sent.status_code == 201, sent.text
    body = {"upload": sent.json()["upload"], "stride": 24, "name": "sent"}
    job = served.client.post("/v1/maps/office/ingest", json=body).json()
    found = ended(served, job)
    assert (found["state"], found["recordings"][0]["keyframes"]) == ("done", 1), found
    assert str(served.folder) not in json.dumps(found)
    other = served.database.create_token("ingest", map="office")
    try:
        with served.with_token(other.secret) as client:
            assert client.post("/v1/maps/office/ingest", json=body).status_code == 404  # what somebody else sent
            assert client.get(job["address"]).status_code == 404
    finally:
        served.database.revoke_token(other.token.id)


def test_bombs_and_ways_out_of_a_zip(served: Served) -> None:
    served.service.uploads.folder.mkdir(parents=True, exist_ok=True)
    before = set(served.service.uploads.folder.iterdir())
    bad = {
        413: [zipped({"a": bytes(50 * 2**20)}), zipped({"a": bytes(30 * 2**20)})],  # too large; 1000 to one
        422: [
            zipped({"../a": b"x"}),
            zipped({"/etc/a": b"x"}),
            zipped({"a\\..\\b": b"x"}),
            zipped({"a": b"x"}, link="/etc"),
        ],
    }
    for status, files in bad.items():
        for data in files:
            answer = served.client.post("/v1/uploads", params={"name": "a.zip"}, content=data)
            assert answer.status_code in (status, 201), answer.text
            if answer.status_code == 201:  # what is no zip is a file
                assert answer.json()["bytes"] == len(data)
                before.add(served.service.uploads.folder / answer.json()["upload"])
    lying = bytearray(zipped({"a": bytes(2**20)}))
    place = lying.rindex(b"PK\1\2")
    lying[place + 24 : place + 28] = (1000).to_bytes(4, "little")  # it says that it is small
    answer = served.client.post("/v1/uploads", params={"name": "a.zip"}, content=bytes(lying))
    assert answer.status_code in (413, 422), answer.text
    for name in ("../a", "", "a/b", ".a", "a" * 101):
        assert served.client.post("/v1/uploads", params={"name": name}, content=b"x").status_code == 422, name
    large = served.client.post("/v1/uploads", params={"name": "a"}, content=bytes(21 * 2**20))
    assert large.status_code == 413
    assert set(served.service.uploads.folder.iterdir()) == before


def test_frames_of_a_live_session(served: Served, frames: list[Frame]) -> None:
    made = served.client.post("/v1/uploads/live", params={"name": "live"}).json()
    address = f"/v1/uploads/{made['upload']}/frames"
    for frame in frames[:9:4]:
        camera = frame.camera
        x, y, z = frame.world_from_camera[:3, 3]
        q = semdb.geometry.quat_wxyz_from_rotation(frame.world_from_camera[:3, :3])
        form = {
            "timestamp_ns": frame.timestamp_ns,
            "camera": ",".join(map(repr, (camera.fx, camera.fy, camera.cx, camera.cy))),
            "depth_scale": frame.depth_scale,
            "pose": ",".join(repr(float(value)) for value in (x, y, z, *q)),
        }
        files = {"image": png(frame.image[..., ::-1]), "depth": frame.depth_bytes}
        answer = served.client.post(address, data=form, files=files)
        assert answer.status_code == 201, answer.text
    assert served.client.post(address, data=form, files=files).status_code == 409
    assert served.client.post(address, data=form | {"pose": "1,2,3"}, files=files).status_code == 422
    assert served.client.post(f"/v1/uploads/{'0' * 24}/frames", data=form, files=files).status_code == 404
    job = served.client.post("/v1/maps/live/ingest", json={"upload": made["upload"], "stride": 2}).json()
    found = ended(served, job)
    assert found["state"] in ("done", "failed")
    assert found["error"] is None or "detector" in found["error"], found


def test_what_is_old_is_forgotten(served: Served) -> None:
    jobs, uploads = served.service.jobs, served.service.uploads
    assert jobs is not None
    served.database._store().ensure_map("office")
    old, new = uploads.new("x", "old"), uploads.new("x", "new")
    os.utime(old.folder, (0, 0))
    with served.database._store().engine.begin() as connection:
        for moment in ("2020-01-01 00:00:00", "2999-01-01 00:00:00"):
            connection.exec_driver_sql(
                "INSERT INTO queries (map_id, created_at, image, verdict, confidence, inliers, stage, reason,"
                f" candidates, timing_ms) SELECT id, '{moment}', 'a', 'failed', 0, 0, 's', 'r', '[]', '{{}}' FROM maps"
            )
    before = len(served.database.queries("office"))
    jobs._tidy()
    assert len(served.database.queries("office")) == before - 1
    assert (old.folder.exists(), new.folder.exists()) == (False, True)
    uploads.drop(new)


def test_jobs_have_leases_and_end(served: Served) -> None:
    with semdb.open(served.database.settings.database_url) as database:
        assert served.service.jobs is not None
        bad = served.client.post("/v1/maps/office/ingest", json={"path": "."}).json()  # a folder of many things
        assert ended(served, bad)["state"] in ("done", "failed")
        served.service.jobs._stopping.set()
        served.service.jobs._wake.set()
        served.service.jobs._thread.join(10)
        first = database.job(database.add_job("m", "token 1", {"path": "/nothing"}))
        claimed = database.claim_job()
        assert claimed is not None
        assert (claimed.id, claimed.attempts, database.claim_job()) == (first.id, 1, None)
        database.keep_job(claimed)
        with database._store().engine.begin() as connection:
            connection.exec_driver_sql("UPDATE service_jobs SET lease_until = '2020-01-01' WHERE state = 'running'")
        other = database.claim_job()
        assert other is not None
        assert other.attempts == 2
        with pytest.raises(LeaseLostError):
            database.keep_job(claimed)
        database.end_job(claimed, FAILED, error="late")  # says nothing: another process has it
        assert database.job(first.id).state == "running"
        database.end_job(other, FAILED, error="x")
        assert (database.job(first.id).state, database.open_jobs(), MOST_ATTEMPTS) == ("failed", 0, 5)
        with database._store().engine.begin() as connection:
            connection.exec_driver_sql("UPDATE service_jobs SET finished_at = '2020-01-01' WHERE map = 'm'")
        assert database.forget_jobs(86400) == 1
        with pytest.raises(NotFoundError):
            database.job(first.id)
