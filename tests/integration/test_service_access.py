"""Who may do what over HTTP, and what does not get in."""

from __future__ import annotations

import contextlib
import json
import socket
import struct
import time
import zlib
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
from click.testing import Result
from sqlalchemy import text
from typer.testing import CliRunner
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

import semdb
from semdb.cli.main import app
from semdb.cli.token import seconds_of
from semdb.database.store import open_store
from semdb.database.tokens import hash_of
from semdb.door.access import ROLES
from semdb.errors import NotFoundError, UsageError
from semdb.service.roles import PUBLIC
from semdb.service.settings import ServeSettings
from tests.database_samples import fill
from tests.serving import Served, noise, running

SETTINGS = ServeSettings(max_upload_mb=1.0, max_pixels=1_000_000, body_timeout_s=1.0, sql_time_limit_s=1.0, rate=0)
IN_ADDRESS = {
    "recording": "r",
    "keyframe": "1",
    "landmark": "1",
    "session": "none",
    "job": "1",
    "query": "1",
    "upload_id": "0",
} | {
    "build": "0",
    "name": "0",
}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A service on a map ``m`` of samples, and an empty one, ``other``."""
    folder = tmp_path_factory.mktemp("access")
    url = f"sqlite:///{folder / 'a.sqlite3'}"
    with open_store(url, create=True) as store:
        fill(store)
        store.ensure_map("other")
    settings = SETTINGS.model_copy(update={"ingest_roots": str(folder / "roots"), "uploads": folder / "uploads"})
    with running(semdb.open(url, sql_time_limit_s=1.0, cache_dir=folder / "cache"), settings) as found:
        yield found


@pytest.fixture
def names(served: Served) -> list[str]:
    return [info.name for info in served.database.maps()]


@pytest.fixture
def tokens(served: Served, names: list[str]) -> Iterator[dict[str, str]]:
    """A token of each role for all maps, one of a map, one that was revoked and one that has expired."""
    made = {role: served.database.create_token(role) for role in ROLES}
    made["of a map"] = served.database.create_token("admin", map=names[0])
    made["revoked"] = served.database.create_token("admin")
    served.database.revoke_token(made["revoked"].token.id)
    made["expired"] = served.database.create_token("admin", expires_s=1)
    with served.database._store().engine.begin() as connection:
        past = text("UPDATE access_tokens SET expires_at = '2020-01-01 00:00:00' WHERE id = :id")
        connection.execute(past, {"id": made["expired"].token.id})
    yield {name: new.secret for name, new in made.items()}
    for new in made.values():
        served.database.revoke_token(new.token.id)


def routes(served: Served) -> list[tuple[str, str, str]]:
    """Method, path and role of every route but that of connections and of the document."""
    found = []
    for route in served.api.routes:
        for method in getattr(route, "methods", None) or ():
            role = getattr(route.endpoint, "role", None)
            if role is None:
                assert route.path == "/v1/openapi.json", f"{route.path} has no role"
            elif method != "HEAD":
                found.append((method, route.path, role))
    return found


def test_every_route_asks_for_its_role(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    walked = routes(served)
    assert len(walked) > 25
    for method, path, role in walked:
        for name, secret in tokens.items():
            if method == "DELETE" and name in ("admin", "of a map"):
                continue
            address = path.format(map=names[0], **IN_ADDRESS)
            with served.client.stream(method, address, headers={"Authorization": f"Bearer {secret}"}) as answer:
                if "event-stream" not in answer.headers.get("content-type", ""):
                    answer.read()  # events have no end
                    told: Any = (method, path, name, answer.text[:200])
                else:
                    told = (method, path, name)
            if role == PUBLIC:
                assert answer.status_code < 500 or path == "/ready", told
            elif name in ("revoked", "expired"):
                assert answer.status_code == 401, told
                assert answer.headers["www-authenticate"].startswith("Bearer"), told
            elif name in ROLES and ROLES.index(name) < ROLES.index(role):
                assert answer.status_code == 403, told
                assert f"needs a token of role {role}" in answer.json()["detail"], told
            elif name in ROLES:
                assert answer.status_code not in (401, 403), told
        if role != PUBLIC:
            assert served.client.request(method, path.format(map=names[0], **IN_ADDRESS)).status_code == 401


def test_a_token_of_one_map_sees_no_other(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    with served.with_token(tokens["of a map"]) as client:
        assert [item["name"] for item in client.get("/v1/maps").json()["items"]] == [names[0]]
        for method, path, role in routes(served):
            if "{map}" in path and role != PUBLIC:
                for other in ("other", "attic"):  # there or not: the same answer
                    answer = client.request(method, path.format(map=other, **IN_ADDRESS))
                    assert answer.status_code == 403, (method, path, answer.text)
        for path in (
            "/v1/sql?sql=SELECT 1",
            "/v1/tables",
            "/metrics",
            "/v1/recordings?map=other",
            "/v1/find?what=cup&map=other",
        ):
            assert client.get(path).status_code == 403, path
        keyframe = served.database.keyframes(names[0])[0].id
        assert client.get(f"/v1/keyframes/{keyframe}").status_code == 200
    other = served.database.create_token("read", map="other")
    with served.with_token(other.secret) as client:
        for what in ("", "/image", "/depth", "/objects", "/mask", "/keypoints", "/picture"):
            answer = client.get(f"/v1/keyframes/{keyframe}{what}")
            assert (answer.status_code, answer.json()["detail"]) == (404, f"there is no keyframe {keyframe}")
        assert client.get("/v1/recordings").json()["items"] == []
    served.database.revoke_token(other.token.id)


def test_tokens_are_hashes_and_end_at_once(served: Served, tokens: dict[str, str]) -> None:
    new = served.database.create_token("read", name="robot 3")
    with served.with_token(new.secret) as client:
        assert client.get("/v1/maps").status_code == 200
        served.database.revoke_token(new.token.id)
        replayed = client.get("/v1/maps")
        assert (replayed.status_code, new.secret in replayed.text) == (401, False)
    with served.database._store().engine.connect() as connection:
        stored = [tuple(row) for row in connection.execute(text("SELECT * FROM access_tokens"))]
    assert not any(new.secret in map(str, row) for row in stored)
    assert any(hash_of(new.secret) in row for row in stored)
    assert "robot 3" in [token.name for token in served.database.tokens()]
    for given in ({"role": "king"}, {"role": "read", "expires_s": 0}, {"role": "read", "name": "a\nb"}):
        with pytest.raises(UsageError):
            served.database.create_token(**given)
    with pytest.raises(NotFoundError):
        served.database.create_token("read", map="attic")
    for header in ("Basic abc", "Bearer", "Bearer semdb_x", "Bearer " + "x" * 5000):
        assert served.client.get("/v1/maps", headers={"Authorization": header}).status_code == 401


def test_statements_do_not_show_tokens(served: Served, tokens: dict[str, str]) -> None:
    with served.with_token(tokens["admin"]) as client:
        for statement in (
            "SELECT * FROM access_tokens",
            'SELECT "hash" FROM main."access_tokens"',
            "WITH t AS (SELECT hash FROM access_tokens) SELECT COUNT(*) FROM t",
            "SELECT 1 WHERE EXISTS (SELECT 1 FROM access_tokens WHERE role = 'admin')",
            "SELECT * FROM pragma_table_info('access_tokens')",
            "ATTACH DATABASE '/tmp/x' AS x",
            "PRAGMA table_list",
            "INSERT INTO maps(name) VALUES ('x')",
            "SELECT load_extension('x')",
            "SELECT 1; DROP TABLE maps",
        ):
            answer = client.get("/v1/sql", params={"sql": statement})
            assert answer.status_code == 422, (statement, answer.text)
            assert hash_of(tokens["admin"]) not in answer.text
        assert "access_tokens" not in client.get("/v1/tables").json()["tables"]


EVIL = ("'; DROP TABLE maps; --", '" OR 1=1 UNION SELECT hash FROM access_tokens --', "../../../etc/passwd", "\x00🤖%")


def parameters(served: Served) -> Iterator[tuple[str, str, str, str, dict[str, str]]]:
    """Method, path, kind and name of every parameter of every route, and the others that the route asks for."""
    document = served.api.openapi()
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            listed = operation.get("parameters", [])
            needed = {
                one["name"]: str(one["schema"].get("examples", ["1"])[0])
                for one in listed
                if one["in"] == "query" and one.get("required")
            }
            for one in listed:
                yield method, path, one["in"], one["name"], needed
            for kind, content in operation.get("requestBody", {}).get("content", {}).items():
                schema = content["schema"]
                schema = document["components"]["schemas"].get(schema.get("$ref", "").rpartition("/")[2], schema)
                for name in schema.get("properties", {}):
                    yield method, path, kind, name, needed


def test_no_parameter_is_a_statement_or_a_path(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    before, walked = served.database.maps(), list(parameters(served))
    assert len(walked) > 150
    with served.with_token(tokens["admin"]) as client:
        for number, (method, path, where, name, needed) in enumerate(walked):
            if (method, path) == ("get", "/v1/sql") and name == "sql":
                continue
            for evil in EVIL if where in ("query", "path") else EVIL[number % 2 :: 2]:
                given: dict[str, Any] = {"params": needed}
                in_address = {"map": names[0], **IN_ADDRESS}
                if where == "path":
                    in_address[name] = "".join(f"%{byte:02X}" for byte in evil.encode())
                elif where == "query":
                    given["params"] = needed | {name: evil}
                elif where == "application/json":
                    given["json"] = {name: evil}
                else:
                    given |= {"data": {name: evil}, "files": {"image": noise(32, 24)}}
                with client.stream(method, path.format(**in_address), **given) as answer:
                    if "event-stream" not in answer.headers.get("content-type", ""):
                        answer.read()
                        assert "root:" not in answer.text
                        shown = answer.text.replace("'sqlite", "")
                        assert "sqlite" not in shown, (path, name, shown)
                        assert str(served.folder) not in shown, (path, name, shown)
                assert answer.status_code < 500 or path == "/ready" or "model" in answer.text, (path, name, answer.text)
    assert served.database.maps() == before


def test_like_is_no_folder(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    with served.with_token(tokens["admin"]) as client:
        for like in ("/etc", str(served.folder), "."):
            answer = client.post(f"/v1/maps/{names[0]}/localize", data={"like": like}, files={"image": noise()})
            assert (answer.status_code, "there is no recording" in answer.json()["detail"]) == (422, True)


def huge_png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = zlib.compress(b"\0" * 1_000_000)
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def test_bombs_and_large_bodies(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    address = f"/v1/maps/{names[0]}/localize"
    with served.with_token(tokens["localize"]) as client:
        bomb = client.post(address, files={"image": huge_png(10_000, 10_000)})
        assert (bomb.status_code, "10000x10000 pixels" in bomb.json()["detail"]) == (413, True)
        depth = client.post(
            address, files={"image": noise(), "depth": huge_png(9000, 9000)}, data={"depth_scale": "1000"}
        )
        assert depth.status_code == 413
        large = client.post(address, files={"image": b"x" * 3_000_000})
        assert (large.status_code, large.json()["detail"]) == (413, "the body is larger than 1 MiB")

        def pieces() -> Iterator[bytes]:
            yield b'--b\r\nContent-Disposition: form-data; name="image"; filename="x"\r\n\r\n'
            for _ in range(3000):
                yield b"x" * 1000

        chunked = client.post(address, content=pieces(), headers={"Content-Type": "multipart/form-data; boundary=b"})
        assert chunked.status_code == 413
        deep = client.post(
            f"/v1/maps/{names[0]}/sessions", content="[" * 5000, headers={"Content-Type": "application/json"}
        )
        assert deep.status_code == 422
        long = client.post(f"/v1/maps/{names[0]}/sessions", json={"camera": "1" * 100_000})
        assert long.status_code == 413
        masks = client.post(
            address,
            files={"image": noise(), "instances": noise()},
            data={"categories": json.dumps({"1": "chair"}), "camera": "300,300,160,120"},
        )
        assert masks.status_code in (422, 503), masks.text


def test_a_body_that_comes_slowly_is_let_go(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    host, port = served.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port)), timeout=10) as slow:
        head = (
            f"POST /v1/maps/{names[0]}/localize HTTP/1.1\r\nHost: {host}\r\n"
            f"Authorization: Bearer {tokens['localize']}\r\n"
            "Content-Type: multipart/form-data; boundary=b\r\nContent-Length: 1000\r\n\r\n--b"
        )
        slow.sendall(head.encode())
        started = time.monotonic()
        answer = slow.recv(65536)
        assert b" 408 " in answer.partition(b"\r\n")[0], answer
        assert 0.5 < time.monotonic() - started < 8


def test_a_body_that_nobody_asked_for_is_not_read(served: Served, tokens: dict[str, str]) -> None:
    host, port = served.url.removeprefix("http://").split(":")
    for kind in ("multipart/form-data; boundary=b", "application/json"):
        with socket.create_connection((host, int(port)), timeout=10) as unknown:  # anybody may ask for this
            head = f"GET /health HTTP/1.1\r\nHost: {host}\r\nContent-Type: {kind}\r\nContent-Length: 1000\r\n\r\n"
            unknown.sendall(head.encode())
            assert b" 200 " in unknown.recv(65536).partition(b"\r\n")[0]
        with served.with_token(tokens["ingest"]) as client:  # what is sent to be kept goes to the disk, whatever it is
            headers = {"Content-Type": kind}
            sent = client.post("/v1/uploads", params={"name": "a"}, content="[" * 5000, headers=headers)
            assert (sent.status_code, sent.json()["bytes"]) == (201, 5000)


def test_a_client_that_breaks_off_leaves_nothing_behind(
    served: Served, tokens: dict[str, str], names: list[str]
) -> None:
    host, port = served.url.removeprefix("http://").split(":")
    head = (
        f"POST /v1/maps/{names[0]}/localize HTTP/1.1\r\nHost: {host}\r\nAuthorization: Bearer {tokens['localize']}\r\n"
        "Content-Type: multipart/form-data; boundary=b\r\nContent-Length: 100000\r\n\r\n--b\r\n"
    )
    for _ in range(8):
        with socket.create_connection((host, int(port)), timeout=10) as broken:
            broken.sendall(head.encode() + b"x" * 50_000)
    forms, ends = served.service.forms, time.monotonic() + 20
    while forms.held and time.monotonic() < ends:
        time.sleep(0.02)
    assert (forms.held, served.service.localizing.inside) == (0, 0)
    with served.with_token(tokens["localize"]) as client:
        address = f"/v1/maps/{names[0]}/localize"
        assert client.post(address, files={"image": b"none"}).status_code == 422
    assert forms.held == 0


def test_headers_that_come_slowly_are_let_go(served: Served) -> None:
    host, port = served.url.removeprefix("http://").split(":")
    whole = f"GET /health HTTP/1.1\r\nHost: {host}\r\n\r\n".encode()
    starts = (b"", whole[:-4], whole + whole[:-4])  # nothing, a part of the first request, a part of the second one
    started = time.monotonic()
    with contextlib.ExitStack() as stack:
        slow = [stack.enter_context(socket.create_connection((host, int(port)), timeout=20)) for _ in starts]
        for one, start in zip(slow, starts, strict=True):
            one.sendall(start)
        for one in slow:
            while one.recv(65536):  # the answer to a whole one, then the end
                pass
    assert 0.5 < time.monotonic() - started < 15
    with httpx.Client(base_url=served.url) as client:  # whoever is quick may stay
        for _ in range(3):
            assert client.get("/health").status_code == 200
            time.sleep(0.4)


def test_pages_of_other_places_get_nothing(served: Served, tokens: dict[str, str]) -> None:
    with served.with_token(tokens["admin"]) as client:
        for headers in (
            {"Origin": "https://evil.example"},
            {"Origin": "null"},
            {"Origin": served.url.replace("127.0.0.1", "127.0.0.1.evil.example")},
            {"Sec-Fetch-Site": "cross-site"},
            {"Host": "evil.example"},
            {"Host": "evil.example:8765"},
        ):
            for method in ("GET", "POST"):
                answer = client.request(method, "/v1/maps", headers=headers)
                assert answer.status_code == 403, headers
                assert "access-control-allow-origin" not in answer.headers
        assert client.get("/v1/maps", headers={"Origin": served.url}).status_code == 200
        followed = {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate"}
        assert client.get("/v1/maps", headers=followed).status_code == 200
        answer = client.options("/v1/maps", headers={"Origin": served.url, "Access-Control-Request-Method": "POST"})
        assert "access-control-allow-origin" not in answer.headers
    address = f"ws{served.url.removeprefix('http')}/v1/sessions/x/stream"
    for headers in ({"Origin": "https://evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
        with pytest.raises(InvalidStatus) as refused:
            connect(address, additional_headers=headers | {"Authorization": f"Bearer {tokens['admin']}"})
        assert refused.value.response.status_code == 403
    policy = served.client.get("/health").headers["content-security-policy"]
    assert policy.startswith("default-src 'none'")
    assert "http:" not in policy
    assert "unsafe" not in policy


def test_who_is_ready_names_no_map(served: Served) -> None:
    answer = served.client.get("/ready")  # the models of the samples are made up
    assert (answer.status_code, answer.json()["checks"]) == (503, {"database": "ok", "maps": "0 of 1 can be asked"})


def test_without_a_token_only_this_machine_is_served(served: Served) -> None:
    assert [token for token in served.database.tokens() if token.revoked_at is None] == []
    assert served.client.get("/v1/maps").status_code == 200
    passed_on = served.client.get("/v1/maps", headers={"X-Forwarded-For": "10.0.0.1"})
    assert (passed_on.status_code, "a proxy" in passed_on.json()["detail"]) == (401, True)
    done = command(served, "serve", "--host", "0.0.0.0", "--port", "0")
    assert (done.exit_code, "nobody has a token" in done.stderr) == (2, True), done.stderr


def command(served: Served, *arguments: object) -> Result:
    given = [*map(str, arguments), "--database-url", served.database.settings.database_url]
    return CliRunner().invoke(app, given)


def test_the_end_of_the_last_token_opens_nothing(served: Served) -> None:
    new = served.database.create_token("read", expires_s=60)
    with served.database._store().engine.begin() as connection:
        past = text("UPDATE access_tokens SET expires_at = '2020-01-01 00:00:00' WHERE id = :id")
        connection.execute(past, {"id": new.token.id})
    assert served.client.get("/v1/maps").status_code == 401
    served.database.revoke_token(new.token.id)
    assert served.client.get("/v1/maps").status_code == 200


def test_commands_make_list_and_revoke(served: Served) -> None:
    made = command(served, "token", "create", "--role", "read", "--expires", "2d", "--name", "page")
    assert made.exit_code == 0, made.stderr
    secret = made.stdout.strip()
    assert (secret.startswith("semdb_"), len(made.stdout.splitlines())) == (True, 1)
    with served.with_token(secret) as client:
        assert client.get("/v1/maps").status_code == 200
    assert secret not in command(served, "token", "list").stdout
    listed = json.loads(command(served, "token", "list", "--json").stdout)
    [row] = [row for row in listed if row["name"] == "page"]
    assert (row["role"], row["map"], "hash" in row) == ("read", None, False)
    assert command(served, "token", "revoke", row["id"]).exit_code == 0
    with served.with_token(secret) as client:
        assert client.get("/v1/maps").json()["detail"].startswith("the token is not known")
    with pytest.raises(UsageError, match="--expires soon"):
        seconds_of("soon")


def test_a_token_asks_only_so_often(served: Served, tokens: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    from semdb.service.problems import Problem
    from semdb.service.roles import Rates

    rates = Rates(rate=10, burst=3)
    for _ in range(3):
        rates.take("a")
    with pytest.raises(Problem) as told:
        rates.take("a")
    assert (told.value.status, told.value.headers["Retry-After"]) == (429, "1")
    rates.take("b")
    time.sleep(0.15)
    rates.take("a")
    monkeypatch.setattr(served.service, "rates", Rates(rate=0.01, burst=2))
    with served.with_token(tokens["read"]) as client, served.with_token(tokens["admin"]) as other:
        answers = [client.get("/v1/maps") for _ in range(3)]
        assert [answer.status_code for answer in answers] == [200, 200, 429]
        assert (answers[2].headers["Retry-After"], other.get("/v1/maps").status_code) == ("100", 200)


def test_what_is_deleted_was_confirmed(served: Served, tokens: dict[str, str], names: list[str]) -> None:
    keyframe = served.database.keyframes(names[0])[-1].id
    with served.with_token(tokens["admin"]) as client, served.with_token(tokens["of a map"]) as other:
        asked: Any = client.delete(f"/v1/keyframes/{keyframe}")
        assert (asked.status_code, asked.json()["deletes"]) == (428, {"recordings": 0, "keyframes": 1})
        confirm = asked.json()["confirmation"]
        for address, who in (
            (f"/v1/keyframes/{served.database.keyframes(names[0])[0].id}", client),
            (f"/v1/keyframes/{keyframe}", other),
            (f"/v1/maps/{names[0]}", client),
        ):
            assert who.delete(address, params={"confirm": confirm}).status_code == 409, address
        assert client.delete(f"/v1/keyframes/{keyframe}", params={"confirm": confirm + "A"}).status_code == 409
        done = client.delete(f"/v1/keyframes/{keyframe}", params={"confirm": confirm})
        assert (done.status_code, done.json()) == (200, {"recordings": 0, "keyframes": 1})
        assert client.get(f"/v1/keyframes/{keyframe}").status_code == 404
        confirm = client.delete("/v1/maps/other").json()["confirmation"]
        assert client.delete("/v1/maps/other", params={"confirm": confirm}).status_code == 200
    assert [info.name for info in served.database.maps()] == names[:1]
