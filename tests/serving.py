"""A service of this process on loopback, for tests."""

from __future__ import annotations

import contextlib
import json
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
import uvicorn

from semdb.api import Database
from semdb.database.engine import parse_url
from semdb.service.app import make_api, wrapped
from semdb.service.patient import patient
from semdb.service.settings import ServeSettings
from semdb.service.state import Service
from semdb.types import Frame


@dataclass
class Served:
    """A service that runs: `api` its routes, `client` asks it without a token."""

    service: Service
    api: Any
    url: str
    client: httpx.Client

    @property
    def database(self) -> Database:
        return self.service.database

    @property
    def folder(self) -> Path:
        """Where the database of a SQLite file is."""
        return Path(str(parse_url(self.database.settings.database_url).database)).parent

    def with_token(self, secret: str) -> httpx.Client:
        return httpx.Client(base_url=self.url, headers={"Authorization": f"Bearer {secret}"}, timeout=60)


@contextlib.contextmanager
def running(database: Database, settings: ServeSettings) -> Iterator[Served]:
    """Serves `database` by a server in a thread until the end."""
    from semdb.service.run import _say

    database._say = database._here.say = _say
    service = Service(database, settings)
    api = make_api(service)
    given = {"log_config": None, "access_log": False, "lifespan": "on", "http": patient(settings.body_timeout_s)}
    config = uvicorn.Config(wrapped(api, service), port=0, **given)
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        assert thread.is_alive()
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    try:
        with httpx.Client(base_url=url, timeout=60) as client:
            yield Served(service, api, url, client)
    finally:
        server.should_exit = True
        thread.join(30)


def png(values: Any) -> bytes:
    return bytes(cv2.imencode(".png", values)[1])


def form_of(frame: Frame, *, depth: bool = False, name: str = "frame") -> tuple[dict[str, str], dict[str, Any]]:
    """A frame with its masks as fields and files of a form."""
    camera = frame.camera
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion)
    assert frame.instances is not None
    form = {
        "camera": ",".join(map(repr, numbers)),
        "name": name,
        "frame_index": str(frame.index),
        "timestamp_ns": str(frame.timestamp_ns),
        "categories": json.dumps({str(label): text for label, text in frame.instances.categories.items()}),
    }
    files: dict[str, Any] = {
        "image": ("image.png", png(frame.image[..., ::-1])),
        "instances": ("instances.png", png(frame.instances.labels)),
    }
    if depth and frame.depth_bytes is not None:
        files["depth"] = ("depth.png", frame.depth_bytes)
        form["depth_scale"] = repr(frame.depth_scale)
    return form, files


def noise(width: int = 320, height: int = 240, seed: int = 0) -> bytes:
    """A picture of nothing."""
    return png(np.random.default_rng(seed).integers(0, 255, (height, width, 3), np.uint8))
