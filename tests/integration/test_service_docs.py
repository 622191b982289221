"""docs/service.md: its commands are run, and it names every route."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import pytest

from semdb.api import Database
from semdb.service.app import make_api
from semdb.service.settings import ServeSettings
from semdb.service.state import Service
from semdb.settings import Settings
from tests.conftest import REPOSITORY
from tests.integration.conftest import constant_networks
from tests.integration.opened import opener
from tests.integration.test_docs import blocks, run
from tests.serving import Served, running

PAGE = REPOSITORY / "docs" / "service.md"
RECORDING = "rgbd_dataset_freiburg1_desk"


@pytest.fixture
def served(room: Path, tmp_path: Path) -> Iterator[Served]:
    shutil.copytree(room, tmp_path / RECORDING)
    picture = cv2.imread(str(sorted((room / "rgb").iterdir())[1]))
    cv2.imwrite(str(tmp_path / "photo.png"), cv2.resize(picture, (640, 480)))
    settings = ServeSettings(ingest_roots=str(tmp_path))
    with opener(f"sqlite:///{tmp_path / 'semdb.sqlite3'}", tmp_path / "cache") as opening:
        database = opening(**constant_networks(tmp_path))
        database.ingest(tmp_path / RECORDING, map="office", keyframes=2)
        with running(database, settings) as found:
            yield found


@pytest.mark.long
def test_every_command_of_the_page_works(served: Served) -> None:
    ran = 0
    for block in blocks(PAGE, ("",)):
        if "pip install" in block:
            continue
        for line in block.splitlines():
            command = re.sub(r"\s+#.*", "", line).replace("http://127.0.0.1:8765", served.url)
            if command.startswith("curl"):
                command = command.replace("curl", "curl --silent --show-error --write-out '\\n%{http_code}'", 1)
            done = run(command, served.folder)
            assert done.returncode == 0, f"{command}\n{done.stderr}"
            if command.startswith("curl"):
                status = done.stdout.splitlines()[-1]
                assert status in ("200", "201", "202", "428"), f"{command}\n{done.stdout}"
            ran += 1
            if "token revoke" in command:
                assert [token for token in served.database.tokens() if token.revoked_at is None] == []
    assert ran > 30


def test_every_program_of_the_page_works(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """They stand in the order in which they can be run, beside what curl asks."""
    monkeypatch.chdir(served.folder)
    monkeypatch.delenv("SEMDB_TOKEN", raising=False)
    names: dict[str, Any] = {}
    programs = blocks(PAGE, ("py",))
    for program in programs:
        exec(compile(program.replace("http://127.0.0.1:8765", served.url), "page", "exec"), names)
    names["db"].close()
    assert len(programs) > 8
    assert (names["found"].verdict, len(names["several"])) == (names["anywhere"].verdict, 2)
    assert [job.state for job in names["jobs"]] == ["done"]
    assert served.database.keyframe(1).id == 1  # it was not confirmed


def test_the_page_names_every_route() -> None:
    text, document = PAGE.read_text(), make_api(Service(Database(Settings()), ServeSettings())).openapi()
    for path in document["paths"]:
        start, _, end = path.rpartition("/")
        assert f"`{path}`" in text or f" {path}" in text or (f"`/{end}`" in text and start in text), path


def test_the_page_names_every_parameter() -> None:
    text, document = PAGE.read_text(), make_api(Service(Database(Settings()), ServeSettings())).openapi()
    for path, operations in document["paths"].items():
        for operation in operations.values():
            names = [one["name"] for one in operation.get("parameters", []) if one["in"] == "query"]
            for content in operation.get("requestBody", {}).get("content", {}).values():
                schema = content["schema"].get("$ref", "").rpartition("/")[2]
                names += document["components"]["schemas"].get(schema, {}).get("properties", {})
            for name in names:
                assert f"`{name}`" in text or re.search(rf"\b{name}=", text), (path, name)
