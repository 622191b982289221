"""Ids of rows that many keyframes share (models, categories, cameras): found or made, and remembered.

They are made in small transactions of their own, so that two writers never wait for each other over them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

from sqlalchemy import Connection, Engine, Table, insert, select
from sqlalchemy.exc import IntegrityError

from semdb.database import retry
from semdb.database.tables import cameras, categories, models
from semdb.errors import DatabaseError, UnstorableError, UsageError
from semdb.storable_names import NAME_LENGTH, name_problem
from semdb.types import Camera, ModelInfo

IN_CHUNK = 500


def check_name(what: str, name: str) -> str:
    """`name`, if it can be stored and compared alike on all servers; UsageError if not."""
    problem = name_problem(name)
    if problem is not None:
        raise UsageError(
            f"{_short(name)} cannot be the name of a {what}: it {problem}; 1 to {NAME_LENGTH} printable characters are "
            "needed, no space at either end"
        )
    return name


def _check_category(name: str) -> str:
    problem = name_problem(name)
    if problem is not None:
        raise UnstorableError(f"the class {_short(name)} cannot be stored: its name {problem}")
    return name


def _short(name: str) -> str:
    return repr(name if len(name) <= 60 else f"{name[:57]}...")


def digest(values: Mapping[str, Any]) -> str:
    """SHA-256 of `values` as canonical JSON: the key under which equal rows are one row."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def new_id(connection: Connection, table: Table, row: Mapping[str, Any]) -> int:
    """Adds a row. Returns the id that the database gave it. Raises DatabaseError where it gives none."""
    key = connection.execute(insert(table), row).inserted_primary_key
    if key is None:
        raise DatabaseError(f"the database gave no id for a new row of {table.name}")
    return int(key[0])


def model_row(info: ModelInfo) -> dict[str, Any]:
    row = {"role": info.role, "name": info.name, "sha256": info.sha256, "config": info.config}
    return {**row, "digest": digest(row)}


@lru_cache(maxsize=64)  # every keyframe asks
def camera_row(camera: Camera) -> Mapping[str, Any]:
    row: dict[str, Any] = {
        "model": camera.model,
        "width": int(camera.width),
        "height": int(camera.height),
        **{name: float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy")},
        "distortion": json.dumps([float(value) for value in camera.distortion]),
    }
    return {**row, "digest": digest(row)}


class SharedIds:
    """The ids of models, categories and cameras. Safe to share between threads; `forget` after a deletion."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._known: dict[tuple[str, str], int] = {}

    def forget(self) -> None:
        self._known = {}

    def models(self, infos: Iterable[ModelInfo]) -> dict[ModelInfo, int]:
        wanted = {info: model_row(info) for info in infos}
        ids = self._ensure(models, "digest", list(wanted.values()))
        return {info: ids[row["digest"]] for info, row in wanted.items()}

    def categories(self, names: Iterable[str]) -> dict[str, int]:
        wanted = sorted({_check_category(name) for name in names})
        return self._ensure(categories, "name", [{"name": name} for name in wanted])

    def camera(self, camera: Camera) -> int:
        row = camera_row(camera)
        return self._ensure(cameras, "digest", [row])[row["digest"]]

    def _ensure(self, table: Table, key: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
        missing = [row for row in rows if (table.name, row[key]) not in self._known]
        if missing:
            for row_key, row_id in self._make(table, key, missing).items():
                self._known[table.name, row_key] = row_id
        return {row[key]: self._known[table.name, row[key]] for row in rows}

    def _make(self, table: Table, key: str, rows: Sequence[Mapping[str, Any]]) -> dict[str, int]:
        def find(connection: Connection) -> dict[str, int]:
            keys = [row[key] for row in rows]
            found: dict[str, int] = {}
            for start in range(0, len(keys), IN_CHUNK):
                chunk = keys[start : start + IN_CHUNK]
                query = select(table.c[key], table.c.id).where(table.c[key].in_(chunk))
                found.update((name, row_id) for name, row_id in connection.execute(query))
            return found

        def find_or_make(connection: Connection) -> dict[str, int]:
            found = find(connection)
            for row in rows:
                if row[key] not in found:
                    found[row[key]] = new_id(connection, table, row)
            return found

        for _ in range(10):  # another writer may make the same rows at the same time: then they are there
            try:
                return retry.write(self._engine, find_or_make)
            except IntegrityError:
                continue
        raise DatabaseError(f"rows of {table.name} could not be made: other writers were always faster; try again")
