"""Stores on both servers."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.recordings import open_recording
from semdb.types import Frame
from tests.integration.opened import STRIDE, Opening, opener
from tests.unit.onnx_files import write_constant_model, write_mean_embedding_model


@pytest.fixture
def database_url(empty_url: str) -> str:
    """The URL of a database with the schema and nothing in it."""
    engine = make_engine(empty_url)
    schema.upgrade(engine)
    engine.dispose()
    return empty_url


@pytest.fixture
def store(database_url: str) -> Iterator[Store]:
    with open_store(database_url) as opened:
        yield opened


@pytest.fixture
def open_db(database_url: str, tmp_path: Path) -> Iterator[Opening]:
    """On each server in turn."""
    with opener(database_url, tmp_path / "cache") as opening:
        yield opening


@pytest.fixture
def open_file(tmp_path: Path) -> Iterator[Opening]:
    """On SQLite alone: for what is not the database's."""
    with opener(f"sqlite:///{tmp_path / 'semdb.sqlite3'}", tmp_path / "cache") as opening:
        yield opening


@pytest.fixture(scope="session")
def office(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a SQLite file, ``a.sqlite3``, on the map ``office`` of six keyframes, to be copied."""
    folder = tmp_path_factory.mktemp("office")
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        opening().ingest(room, map="office", stride=STRIDE)
    return folder


@pytest.fixture(scope="session")
def offices(office: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with a second map, ``a/b``, of networks that are in its cache folder."""
    folder = tmp_path_factory.mktemp("offices")
    shutil.copytree(office, folder, dirs_exist_ok=True)
    models = folder / "cache" / "models"
    models.mkdir(parents=True, exist_ok=True)
    with opener(f"sqlite:///{folder / 'a.sqlite3'}", folder / "cache") as opening:
        opening(**constant_networks(models)).ingest(room, map="a/b", name="stairs", stride=12)
    return folder


@pytest.fixture(scope="module")
def frames(room: Path) -> list[Frame]:
    return list(open_recording(room).frames())


@pytest.fixture
def networks(tmp_path: Path) -> dict[str, str]:
    """A detector that always sees a chair, and an encoder: for images without masks of their own."""
    return constant_networks(tmp_path)


def constant_networks(folder: Path) -> dict[str, str]:
    """The same, in a folder."""
    masks = np.zeros((1, 1, 240, 320), np.float32)
    masks[:, :, 40:200, 60:260] = 1
    detector = write_constant_model(
        folder / "mask_rcnn.onnx",
        {
            "boxes": np.array([[60, 40, 259, 199]], np.float32),
            "labels": np.array([62], np.int64),
            "scores": np.array([0.9], np.float32),
            "masks": masks,
        },
    )
    encoder = write_mean_embedding_model(folder / "places.onnx")
    return {"detector": f"onnx:{detector}", "encoder": f"onnx:{encoder}"}
