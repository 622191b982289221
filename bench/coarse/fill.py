"""Filling a database with a made-up world in bulk: rows stream from the generator through a pipe into LOAD DATA."""

from __future__ import annotations

import contextlib
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pymysql
from sqlalchemy import insert

from bench.coarse.world import CATEGORIES, LENGTH, World
from semdb.class_score import MOST_OBJECTS, UNITS
from semdb.cli.progress import Progress
from semdb.database import schema, tables
from semdb.database.codecs import encode_array, encode_mask
from semdb.database.engine import make_engine
from semdb.database.ids import camera_row, model_row
from semdb.types import Camera, ModelInfo
from tests.servers import TestServer

MAP = "made-up"
VERSION = 2  # of what is filled in: a kept server that holds another one is filled anew
MODELS = (
    ModelInfo("detector", "made-up", "", "{}"),
    ModelInfo("encoder", "made-up", "", "{}"),
    ModelInfo("features", "made-up", "", "{}"),
)
CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
DETECTOR, ENCODER, FEATURES, MAP_ID, CAMERA_ID = 1, 2, 3, 1, 1
MASK = encode_mask(np.pad(np.ones((2, 2), np.bool_), 1))
# Rows of one connection, loaded once: nothing to be checked, nothing to be kept for a crash.
SESSION = "SET unique_checks = 0, foreign_key_checks = 0, time_zone = '+00:00', lock_wait_timeout = 60"

Lines = Callable[[World, int], bytes]


def fill(server: TestServer, keyframes: int, world: World) -> str:
    """The URL of a schema with a map of `keyframes` (a multiple of 1000); one that is there is used again."""
    recordings, rest = divmod(keyframes, LENGTH)
    if rest or not recordings:
        raise SystemExit(f"bench.coarse: {keyframes} keyframes are not a multiple of {LENGTH}")
    name = f"semdb_coarse_{keyframes}_{world.seed}_v{VERSION}"
    url = server.admin.set(database=name).render_as_string(hide_password=False)
    with contextlib.closing(_connect(server)) as connection, connection.cursor() as cursor:
        if _is_filled(cursor, name):
            _upgrade(url)
            return url
        cursor.execute("SHOW DATABASES LIKE %s", (name.partition("_v")[0].replace("_", "\\_") + "%",))
        for (other,) in cursor.fetchall():  # of another version, or not filled to the end
            cursor.execute(f"DROP DATABASE `{other}`")
        cursor.execute(f"CREATE DATABASE `{name}` CHARACTER SET utf8mb4 COLLATE utf8mb4_bin")
        _upgrade(url)
        engine = make_engine(url)
        with engine.begin() as rows:
            rows.execute(insert(tables.models), [model_row(info) for info in MODELS])
            rows.execute(insert(tables.cameras), camera_row(CAMERA))
            rows.execute(insert(tables.categories), [{"name": name} for name in CATEGORIES])
        engine.dispose()
        cursor.execute(f"USE `{name}`")
        cursor.execute(SESSION)
        for table, (columns, lines) in LOADS.items():
            with Progress(f"{keyframes} keyframes: {table}", "recordings") as progress:
                _load(connection, table, columns, lines, world, recordings, progress)
        for role, model in (("detector", DETECTOR), ("encoder", ENCODER), ("features", FEATURES)):
            cursor.execute("INSERT INTO map_models (map_id, role, model_id) VALUES (%s, %s, %s)", (MAP_ID, role, model))
        cursor.execute("ANALYZE TABLE " + ", ".join(LOADS))
        # Last of all: a database that has its map is whole.
        cursor.execute("INSERT INTO maps (id, name) VALUES (%s, %s)", (MAP_ID, MAP))
        connection.commit()
    return url


def _connect(server: TestServer) -> pymysql.Connection:
    url = server.admin
    return pymysql.connect(
        host=url.host,
        port=url.port or 3306,
        user=url.username,
        password=str(url.password or ""),
        local_infile=True,
        charset="utf8mb4",
    )


def _is_filled(cursor: pymysql.cursors.Cursor, name: str) -> bool:
    try:
        return bool(cursor.execute(f"SELECT id FROM `{name}`.maps WHERE id = %s", (MAP_ID,)))
    except (pymysql.err.ProgrammingError, pymysql.err.OperationalError):  # no such schema, or no such table
        return False


def _upgrade(url: str) -> None:
    engine = make_engine(url)
    schema.upgrade(engine)
    engine.dispose()


def _load(
    connection: pymysql.Connection,
    table: str,
    columns: str,
    lines: Lines,
    world: World,
    recordings: int,
    progress: Progress,
) -> None:
    """Send what `lines` makes of each recording into `table`. A thread writes into a pipe that the driver reads."""
    failure: list[BaseException] = []

    def write(pipe: Path) -> None:
        try:
            with pipe.open("wb") as stream:
                for number in range(recordings):
                    stream.write(lines(world, number))
                    progress.update(number + 1, recordings)
        except BaseException as error:
            failure.append(error)

    with tempfile.TemporaryDirectory() as folder:
        pipe = Path(folder) / table
        os.mkfifo(pipe)
        writer = threading.Thread(target=write, args=(pipe,), daemon=True)
        writer.start()
        with connection.cursor() as cursor:
            cursor.execute(f"LOAD DATA LOCAL INFILE '{pipe}' INTO TABLE {table} CHARACTER SET binary ({columns})")
        writer.join()
    if failure:
        raise failure[0]
    connection.commit()


def _first_id(number: int) -> int:
    return number * LENGTH + 1


def _text(rows: Iterator[tuple[object, ...]]) -> bytes:
    return "".join("\t".join(map(str, row)) + "\n" for row in rows).encode()


def _recordings(world: World, number: int) -> bytes:
    return _text(iter([(number + 1, MAP_ID, f"walk {number}", "synthetic", "", "0" * 64, LENGTH, "complete")]))


def _keyframes(world: World, number: int) -> bytes:
    latent = world.trajectory(number).latent
    rng = np.random.default_rng([world.seed, 5, number])
    turn = rng.normal(0, 1, (LENGTH, 4))
    turn /= np.linalg.norm(turn, axis=1, keepdims=True)
    rows = zip(range(LENGTH), turn.tolist(), (5 * latent[:, :3].astype(float)).tolist(), strict=True)
    first = _first_id(number)
    return _text((first + i, number + 1, i, i * 33_333_333, CAMERA_ID, *quat, *at) for i, quat, at in rows)


def _changes(world: World, number: int) -> bytes:
    first = _first_id(number)
    return _text((first + i, MAP_ID, first + i, "added") for i in range(LENGTH))


def _objects(world: World, number: int) -> bytes:
    seen = world.seen(number)
    starts = np.searchsorted(seen.keyframe, np.arange(LENGTH))
    ordinal = np.arange(len(seen.keyframe)) - starts[seen.keyframe]
    top = CAMERA.height // 2 + 15 * seen.height - 50  # 15 pixels are a 32nd of the image
    values = (seen.keyframe + _first_id(number), ordinal, seen.category + 1, seen.score, top, top + 99)
    rest = f"{DETECTOR}\t100\t199\t10000\t".encode() + _escape(MASK) + b"\n"
    rows = zip(*(column.tolist() for column in values), strict=True)
    return b"".join("".join(f"{value}\t" for value in row).encode() + rest for row in rows)


def _keyframe_categories(world: World, number: int) -> bytes:
    """One row per keyframe and class, with the strengths that `semdb.class_score.strengths` gives."""
    seen = world.seen(number)
    keys, group, counts = np.unique(
        seen.keyframe * len(CATEGORIES) + seen.category, return_inverse=True, return_counts=True
    )
    keyframe, category = np.divmod(keys, len(CATEGORIES))
    above = 0.5 - seen.height / 16
    parts = [np.bincount(group, seen.score * share, len(keys)) for share in (above, 1 - above)]
    upper, lower = (np.minimum(MOST_OBJECTS, np.rint(UNITS * part)).astype(int) for part in parts)
    held = np.bincount(keyframe, upper + lower, LENGTH).astype(int)[keyframe]
    values = (category + 1, keyframe + _first_id(number), counts, upper, lower, held)
    rows = zip(*(column.tolist() for column in values), strict=True)
    return _text((*row, DETECTOR, MAP_ID) for row in rows)


def _vectors(world: World, number: int) -> bytes:
    vectors = world.recording_vectors(number)
    first = _first_id(number)
    return b"".join(
        f"{first + i}\t{ENCODER}\t".encode() + _escape(encode_array(row)) + b"\n" for i, row in enumerate(vectors)
    )


def _escape(blob: bytes) -> bytes:
    return blob.replace(b"\\", b"\\\\").replace(b"\t", b"\\\t").replace(b"\n", b"\\\n")


LOADS: dict[str, tuple[str, Lines]] = {
    "recordings": ("id, map_id, name, format, source, fingerprint, frame_count, state", _recordings),
    "keyframes": ("id, recording_id, frame_index, timestamp_ns, camera_id, qw, qx, qy, qz, tx, ty, tz", _keyframes),
    "keyframe_changes": ("id, map_id, keyframe_id, kind", _changes),
    "objects": ("keyframe_id, ordinal, category_id, score, y1, y2, model_id, x1, x2, pixel_area, mask", _objects),
    "keyframe_categories": (
        "category_id, keyframe_id, count, upper_strength, lower_strength, keyframe_strength, model_id, map_id",
        _keyframe_categories,
    ),
    "cnn_vectors": ("keyframe_id, model_id, vector", _vectors),
}
