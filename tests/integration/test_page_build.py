"""The page that is committed is what web/ builds, and what it is served as."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import httpx
import pytest

import semdb
from semdb.database.store import open_store
from semdb.service.explorer import FOLDER, load_page
from semdb.service.settings import ServeSettings
from tests.serving import running

REPOSITORY = Path(__file__).resolve().parents[2]
WEB = REPOSITORY / "web"
BROWSER = {"Accept": "text/html,*/*;q=0.8", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Site": "none"}


@pytest.fixture(scope="module")
def npm() -> str:
    """npm, which is an error to lack where SEMDB_TEST_REQUIRE_NODE says so."""
    found = shutil.which("npm")
    if found is None:
        missing("no npm: scripts/install-services.sh installs it")
    assert found is not None
    if not (WEB / "node_modules" / ".stamp").is_file():
        command = [found, "ci", "--no-audit", "--no-fund"]
        if subprocess.run(command, cwd=WEB, capture_output=True, check=False, timeout=300).returncode != 0:
            missing("npm ci failed in web/: it needs a registry of npm")
    return found


def missing(reason: str) -> NoReturn:
    """Skips, or fails where SEMDB_TEST_REQUIRE_NODE says so."""
    if os.environ.get("SEMDB_TEST_REQUIRE_NODE", "0") not in ("", "0"):
        pytest.fail(f"{reason}, and SEMDB_TEST_REQUIRE_NODE is set", pytrace=False)
    pytest.skip(reason)


def run(*command: str, cwd: Path) -> None:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}"


def test_what_is_committed_is_what_is_built(npm: str, tmp_path: Path) -> None:
    run(npm, "run", "--silent", "check", cwd=WEB)
    run("node", "build.mjs", str(tmp_path / "page"), cwd=WEB)
    built = {file.name: file.read_bytes() for file in (tmp_path / "page").iterdir()}
    kept = {file.name: file.read_bytes() for file in FOLDER.iterdir() if file.name != "__pycache__"}
    assert sorted(kept) == sorted(built), "make web"
    assert [name for name in built if built[name] != kept[name]] == [], "make web"


def test_the_lock_names_no_registry_and_versions_are_exact() -> None:
    lock = (WEB / "package-lock.json").read_text()
    assert '"resolved"' not in lock
    assert "://" not in re.sub(r'"(funding|url|license)": .*', "", lock)
    versions = re.findall(r'"[^"]+": "([^"]+)"', (WEB / "package.json").read_text().split('"devDependencies"')[1])
    assert versions
    assert all(re.fullmatch(r"\d+\.\d+\.\d+", version) for version in versions)


def test_the_page_names_nothing_outside_of_itself() -> None:
    page = load_page()
    html = page.files["index.html"].content.decode()
    named = re.findall(r'(?:src|href)="([^"]+)"', html)
    assert named
    assert all(name.startswith(f"/page/{page.build}/") and name.split("/")[3] in page.files for name in named)
    assert not re.search(r"<script(?![^>]* src=)|<style|\son\w+=|style=", html)
    style = page.files["style.css"].content.decode()
    assert not re.search(r"url\((?!['\"]?data:)|@import", style)


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    url = f"sqlite:///{tmp_path_factory.mktemp('page') / 'a.sqlite3'}"
    open_store(url, create=True).close()
    database = semdb.open(url)
    database.create_token("read")  # the page itself is for everyone: it asks for one
    with running(database, ServeSettings()) as served:
        yield served.client


@pytest.mark.parametrize("path", ["/", "/maps", "/maps/a%2Fb/landmarks/3?q=cup", "/nothing/like/it"])
def test_every_address_of_a_browser_is_the_page(client: httpx.Client, path: str) -> None:
    answer = client.get(path, headers=BROWSER)
    assert (answer.status_code, answer.headers["content-type"]) == (200, "text/html; charset=utf-8")
    assert answer.headers["cache-control"] == "private, no-cache"
    policy = answer.headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    again = client.get(path, headers=BROWSER | {"If-None-Match": answer.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")


def test_programs_get_problems_and_no_page(client: httpx.Client) -> None:
    for path, accept in (("/nothing", "*/*"), ("/v1/nothing", "text/html"), ("/page/nothing", "text/html")):
        answer = client.get(path, headers={"Accept": accept})
        assert (answer.status_code, answer.headers["content-type"]) == (404, "application/problem+json"), path
    assert client.post("/maps", headers=BROWSER).status_code == 404
    assert client.get("/v1/maps", headers=BROWSER).status_code == 401


def test_files_of_the_page_never_change_and_are_compressed(client: httpx.Client) -> None:
    page = load_page()
    for name, asset in page.files.items():
        if name == "index.html":
            continue
        answer = client.get(f"/page/{page.build}/{name}")
        assert answer.headers["cache-control"] == "public, max-age=31536000, immutable"
        assert answer.content == asset.content
        assert (answer.headers.get("content-encoding") == "gzip") == (asset.compressed is not None)
        plain = client.get(f"/page/{page.build}/{name}", headers={"Accept-Encoding": "identity"})
        assert "content-encoding" not in plain.headers
        assert plain.content == asset.content
    old = client.get(f"/page/{'0' * 16}/main.js")
    assert (old.status_code, "another version" in old.text) == (404, True)
    assert client.get(f"/page/{page.build}/..%2F__init__.py").status_code == 404


def test_it_is_small() -> None:
    """What is transferred before points, everything that is loaded later included."""
    sizes = {name: len(asset.compressed or asset.content) for name, asset in load_page().files.items()}
    assert sum(sizes.values()) < 400_000, sizes
