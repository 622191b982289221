"""A whole map in a folder, to be imported by another semdb: its rows in a SQLite file, and what they add up to.

All servers have the same tables, so a map travels between SQLite, MariaDB and MySQL as it is: poses, images, objects,
descriptors, refinements, and which models made them.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sqlalchemy import func, select

from semdb.database import retry, schema, tables
from semdb.database.copying import Copied, copy_map
from semdb.database.engine import make_engine
from semdb.database.ids import check_name
from semdb.database.records import MapInfo
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError, RecordingError, SchemaError, UsageError
from semdb.exchange.source import ExportOptions, MapSource, new_folder
from semdb.names import storable

MANIFEST, ROWS = "semdb-map.json", "map.sqlite3"
FORMAT = "semdb-map"
VERSION = 1
BLOCK = 1 << 20
Progress = Callable[[str, int, int], None]


def write_whole(source: MapSource, out: Path, options: ExportOptions) -> str:
    """``map.sqlite3``, and last of all a manifest with its SHA-256, revision and numbers of rows."""
    folder = new_folder(out)
    url = f"sqlite:///{folder / ROWS}"
    engine = make_engine(url)
    try:
        schema.upgrade(engine)

        def tell(done: int, total: int) -> None:
            source.tell("exporting", done, total)

        done = copy_map(source.store.engine, source.map_id, engine, source.name, progress=tell)
        counts = _counts(engine)
    finally:
        engine.dispose()
    connection = sqlite3.connect(folder / ROWS)
    try:
        connection.execute("PRAGMA journal_mode = DELETE")  # one file, without a log beside it
    finally:
        connection.close()
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "map": source.name,
        "revision": schema.HEAD,
        "rows": counts,
        "sha256": _sha256(folder / ROWS),
    }
    (folder / MANIFEST).write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
    return f"{done.keyframes} keyframes of {done.recordings} recordings"


def import_whole(folder: Path, store: Store, map_name: str | None = None, progress: Progress | None = None) -> Copied:
    """Adds the map of `write_whole` under `map_name` or its own name; started again, it goes on.

    Nothing is written before the file was found to be as it was exported. Raises RecordingError for a folder that is
    none, or is damaged, UsageError where another map has the name.
    """
    manifest = read_manifest(folder)
    if progress is not None:
        progress(f"checking {folder.name}", 0, 1)
    if _sha256(folder / ROWS) != manifest["sha256"]:
        raise RecordingError(f"{folder / ROWS}: is not as it was exported (its SHA-256 differs): copy it again")
    with tempfile.TemporaryDirectory(prefix="semdb-import-") as temporary:
        file = _at_head(folder / ROWS, str(manifest["revision"]), Path(temporary))
        with _opened(file, folder / ROWS) as source:
            info = _only_map(source, file, folder / ROWS)
            name = check_name("map", storable(info.name if map_name is None else map_name))
            _check_models(store, name, source)
            _check_recordings(store, name, source, info.id)
            tell = None if progress is None else lambda done, total: progress(f"importing {name}", done, total)
            done = copy_map(source.engine, info.id, store.engine, name, progress=tell)
    return done


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of an exported map. Raises RecordingError for what is none."""
    file = folder / MANIFEST
    if not file.is_file():
        raise RecordingError(f"{folder}: is no map that `semdb export semdb` wrote: {MANIFEST} is missing")
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise RecordingError(f"{file}: cannot be read as JSON: {error}") from error
    keys = ("format", "version", "map", "revision", "sha256")
    if not isinstance(content, dict) or any(key not in content for key in keys) or content["format"] != FORMAT:
        raise RecordingError(f"{file}: is no manifest of an exported map")
    if content["version"] != VERSION:
        raise RecordingError(f"{file}: is of version {content['version']}; this semdb reads version {VERSION}")
    if not (folder / ROWS).is_file():
        raise RecordingError(f"{folder / ROWS}: the file is missing")
    return content


def _at_head(file: Path, revision: str, temporary: Path) -> Path:
    """The file, or a copy of it brought up to the schema of this semdb. Raises SchemaError for a newer one."""
    if revision not in schema.REVISIONS:
        raise SchemaError(f"{file}: has schema revision {revision}, which this semdb does not know: upgrade it")
    copy = temporary / ROWS  # also so that nothing is written beside what may be read only
    shutil.copyfile(file, copy)
    if revision != schema.HEAD:
        engine = make_engine(f"sqlite:///{copy}")
        try:
            schema.upgrade(engine)
        finally:
            engine.dispose()
    return copy


def _opened(file: Path, exported: Path) -> Store:
    """The rows of an export. Raises RecordingError, which names what was exported and not the copy of it."""
    try:
        return open_store(f"sqlite:///{file}")
    except (DatabaseError, SchemaError) as error:
        raise RecordingError(f"{exported}: is no map that `semdb export semdb` wrote: {_about(error, file)}") from error


def _about(error: Exception, file: Path) -> str:
    return str(error).replace(f"sqlite:///{file}", ROWS)


def _only_map(source: Store, file: Path, exported: Path) -> MapInfo:
    """The one map of an export. Raises RecordingError."""
    try:
        found = source.maps()
    except DatabaseError as error:
        raise RecordingError(f"{exported}: cannot be read: {_about(error, file)}") from error
    if len(found) != 1:
        raise RecordingError(f"{exported}: holds {len(found)} maps, but an export has one: export it again")
    return found[0]


def _check_recordings(store: Store, name: str, source: Store, map_id: int) -> None:
    """Raises UsageError where the target's map of that name has what the export has not: poses of another world."""
    r, m = tables.recordings.c, tables.maps.c

    def of(engine: Any, condition: Any) -> dict[str, str]:
        query = select(r.name, r.fingerprint).join(tables.maps, m.id == r.map_id).where(condition)
        return retry.read(engine, lambda connection: {row[0]: row[1] for row in connection.execute(query)})

    own = of(source.engine, m.id == map_id)
    for recording, fingerprint in of(store.engine, m.name == name).items():
        if own.get(recording) != fingerprint:
            raise UsageError(
                f"the map {name!r} has another recording {recording!r} already: import under another name with --map"
            )


def _check_models(store: Store, name: str, source: Store) -> None:
    """Raises UsageError where the target has a map of that name that other models made."""
    there = [info for info in store.maps() if info.name == name]
    if there:
        [info] = source.maps()
        store.check_models(there[0].id, source.map_models(info.id))


def _counts(engine: Any) -> dict[str, int]:
    def work(connection: Any) -> dict[str, int]:
        return {
            table.name: int(connection.execute(select(func.count()).select_from(table)).scalar() or 0)
            for table in tables.metadata.sorted_tables
        }

    return retry.read(engine, work)


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            while block := file.read(BLOCK):
                digest.update(block)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    return digest.hexdigest()
