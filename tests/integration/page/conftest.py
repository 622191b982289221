"""One browser and one served map for all tests of the page; the long tests take more maps, on MySQL too."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semdb.database import accounts, schema
from semdb.database.engine import make_engine
from semdb.recordings import open_recording
from semdb.recordings.synthetic import SyntheticOptions
from semdb.service.settings import ServeSettings
from semdb.types import Frame
from tests.browsing import Visit, chromium, visiting
from tests.integration.opened import opener
from tests.integration.page.helpers import HOSTILE, World
from tests.rooms import render
from tests.servers import TestServer
from tests.serving import running

SMALL = SyntheticOptions(frames=12, width=320, height=240, lap_frames=40)
DEMO = SyntheticOptions(frames=80)  # as scripts/demo.sh has it


@pytest.fixture(scope="package")  # its loop must not run when other tests ask for one
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


LONG = pytest.mark.long
WORLDS = [
    "small-sqlite",
    *(pytest.param(name, marks=LONG) for name in ("demo-sqlite", "demo-mysql", "kitchen-sqlite", "kitchen-mysql")),
]


@pytest.fixture(scope="package", params=WORLDS)
def world(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """A map with things, of a hostile name, beside an empty one."""
    kind, _, server = request.param.partition("-")
    folder = tmp_path_factory.mktemp(request.param)
    with contextlib.ExitStack() as stack:
        settings: dict[str, Any] = {"detector": "auto", "encoder": "auto", "features": "auto"}
        if kind == "kitchen":
            shared: Path = request.getfixturevalue("shared_dir")
            recording = shared / "recordings" / "7scenes_redkitchen" / "seq-01"
            models = shared / "models"
            settings["detector"] = f"onnx:{models / 'mask_rcnn_2go.onnx'}"
            settings["encoder"] = f"onnx:{models / 'squeezenet_places365.onnx'}"
        else:
            recording = render(folder / "room", SMALL if kind == "small" else DEMO)
        url = f"sqlite:///{folder / 'a.sqlite3'}"
        if server == "mysql":
            url, settings["reader_url"] = stack.enter_context(_on_mysql(request.getfixturevalue("mysql_server")))
        database = stack.enter_context(opener(url, folder / "cache"))(**settings)
        how = {"stride": 3} if kind == "small" else {"keyframes": 16}
        database.ingest(recording, map=HOSTILE, **how)
        database.refine(HOSTILE, steps=["landmarks"])
        database._store().ensure_map("empty")
        (folder / "roots" / "broken").mkdir(parents=True)
        served = stack.enter_context(running(database, ServeSettings(ingest_roots=str(folder / "roots"))))
        yield World(
            request.param, HOSTILE, served, recording, _photos(database, recording), needs_masks=kind != "kitchen"
        )


@contextlib.contextmanager
def _on_mysql(server: TestServer) -> Iterator[tuple[str, str]]:
    """An empty schema of MySQL, and how a reader asks it."""
    with server.schema() as url:
        names = {"reader": "page_reader"}
        plan = accounts.plan_accounts(url, roles=("reader",), names=names)
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        accounts.execute(url, plan.statements)
        try:
            yield url, plan.urls["reader"]
        finally:
            server.execute("DROP USER 'page_reader'@'%'")


def _photos(database: Any, recording: Path, most: int = 6) -> list[Frame]:
    opened = open_recording(recording)
    kept = {item.frame_index for item in database.keyframes(HOSTILE)}
    others = [entry for entry in opened.entries if entry.index not in kept]
    return [opened.read(others[int(k)]) for k in np.linspace(0, len(others) - 1, min(most, len(others))).astype(int)]


@pytest.fixture
def visit(browser: Any, world: World) -> Iterator[Visit]:
    with visiting(browser, world.url) as found:
        yield found
