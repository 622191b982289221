"""Databases that tests open as programs do, and what they compare."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from sqlalchemy import select

import semdb
from semdb.api import Answer, Database
from semdb.database import tables
from semdb.geometry import pose_error
from semdb.types import Frame
from tests.integration.comparison import NOT_COMPARED

MODELS = {"detector": "recorded", "encoder": "gist", "features": "surf"}
STRIDE = 4
Opening = Callable[..., Database]
OF_THE_SOURCE = {"format", "source", "fingerprint"}  # of a recording: files and memory differ in these


@contextlib.contextmanager
def opener(url: str, cache_dir: Path) -> Iterator[Opening]:
    """Opens a database as often as one likes; all are closed in the end."""
    with contextlib.ExitStack() as stack:

        def opening(url: str = url, **settings: Any) -> Database:
            given = {**MODELS, "threads": 1, "cache_dir": cache_dir, "say": lambda line: None}
            return stack.enter_context(semdb.open(url, **(given | settings)))

        yield opening


def rows(database: Database) -> dict[str, list[Any]]:
    """All rows of all tables but times and where frames came from."""
    found: dict[str, list[Any]] = {}
    with database._store().engine.connect() as connection:
        for table in tables.metadata.sorted_tables:
            columns = [c for c in table.columns if c.name not in NOT_COMPARED | OF_THE_SOURCE]
            found[table.name] = sorted(map(tuple, connection.execute(select(*columns))), key=repr)
    return found


def close_to(answer: Answer, frame: Frame) -> None:
    assert answer.localized, answer
    assert answer.world_from_camera is not None
    metres, degrees = pose_error(answer.world_from_camera, frame.world_from_camera)
    assert metres < 0.02
    assert degrees < 0.5


def same(one: Answer, other: Answer) -> bool:
    """Equal but for the time that they took."""
    found, wanted = one.as_dict(), other.as_dict()
    del found["timing_ms"], wanted["timing_ms"]
    return json.dumps(found) == json.dumps(wanted)
