"""Damages one column after the other of a populated database, and runs everything that reads it.

``python -m tests.damage FOLDER thin|thick`` prints a line of JSON before and after each operation, so that whoever
started it knows what a process that died was at.
"""

from __future__ import annotations

import json
import resource
import shutil
import sqlite3
import struct
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import DateTime, Double, Integer, LargeBinary, String, Table, Text, TypeDecorator

import semdb
from semdb.cli import status as status_command
from semdb.database.codecs import MASK_MAGIC, decode_array, encode_array
from semdb.database.planning import check_models
from semdb.database.records import StoredImage
from semdb.database.store import Store, open_store
from semdb.database.tables import metadata
from semdb.errors import CodecError, NotFoundError, SemdbError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.localization.images import make_localizer
from semdb.localization.query_image import QueryReader
from semdb.perception.describe import describer_from_specs
from semdb.perception.model_choice import settings_of_map, specs_for_query
from semdb.pictures import localization as pictures
from semdb.recordings.synthetic import SyntheticOptions
from semdb.refinement.run import refine_map
from semdb.refinement.steps import FOR_LOCALIZATION
from semdb.settings import Settings
from semdb.types import Description, Localization
from tests.rooms import render

KEYFRAMES = 4
OF_KEYFRAMES = {
    "cameras",
    "categories",
    "cnn_vectors",
    "descriptors",
    "keyframe_categories",
    "keyframe_images",
    "keyframes",
    "keypoints",
    "object_features",
    "objects",
}
_READ_BY = {
    "index": {"categories", "cnn_vectors", "keyframe_categories", "keyframe_changes", "keyframes"},
    "plot": {"cameras", "keyframe_images", "objects"},
    "refine": {"cameras", "descriptors", "keyframes", "keypoints", "object_features", "objects", "refinements"},
}
_READ_TOO = {  # in passing: once with each damage of any kind
    "index": {"map_models", "maps", "models"},
    "plot": {"categories", "keyframes", "recordings", "refined_points"},
    "refine": {"class_confusions", "maps", "models", "recordings", "refined_points"},
}
HUGE, NOTHING = 2**62, 987_654_321


@dataclass(frozen=True)
class Damage:
    """`value` goes into `column` of one row, the second where there are several, or with `every` of all."""

    table: str
    column: str
    what: str
    value: Any  # a value, or a function of what was there
    every: bool = False

    def __str__(self) -> str:
        return f"{self.table}.{self.column}: {self.what}{', every row' if self.every else ''}"


def make(folder: Path) -> None:
    """A recording with depth and masks, a database of it that has every kind of row, and a query."""
    room = render(folder / "room", SyntheticOptions(frames=12, width=160, height=120, lap_frames=120))
    ingest_recordings([room], settings(folder), IngestOptions(map_name="m", keyframes=KEYFRAMES))
    with open_store(settings(folder).database_url) as store:
        info = store.find_map("m")
        refine_map(store, info, kinds=FOR_LOCALIZATION)
        names = [name for _, name in store.map_categories(info.id)]
        with store.engine.begin() as connection:
            ids = [key for key, _ in store.map_categories(info.id)]
            connection.exec_driver_sql(f"INSERT INTO class_confusions VALUES (1, {ids[0]}, {ids[1]}, 3, 100000)")
            connection.exec_driver_sql("UPDATE refinements SET row_count = 1")
            connection.exec_driver_sql(
                "UPDATE ingest_items SET state = 'running', worker = 'a!b!1!2!3', lease_until = '2030-01-01 00:00:00' "
                "WHERE frame_index = (SELECT MAX(frame_index) FROM ingest_items)"
            )
        assert names
    with closing(sqlite3.connect(folder / "whole.sqlite3")) as connection:
        connection.execute("PRAGMA journal_mode = DELETE")


def settings(folder: Path) -> Settings:
    return Settings(
        database_url=f"sqlite:///{folder / 'whole.sqlite3'}",
        detector="recorded",
        encoder="gist",
        features="orb",
        threads=1,
        max_keypoints=200,
        cache_dir=folder / "cache",
        descriptor_dtype="float32",  # rows whose numbers can be damaged one by one
    )


def damages(thick: bool) -> Iterator[Damage]:
    """What is done to each column: wrong types, what is no number, too large, cut off, empty, of another length."""
    for table in metadata.sorted_tables:
        for column in table.columns:
            kinds = _kinds(table, column.name, column.type)
            for number, (what, value) in enumerate(kinds):
                if thick or number < _THIN.get(table.name, 1) or what.startswith("!"):
                    yield Damage(table.name, column.name, what, value)
                    if thick or what == "!every":
                        yield Damage(table.name, column.name, what, value, every=True)


_THIN = {
    "access_tokens": 0,
    "service_jobs": 0,
    "queries": 0,
    "keypoints": 2,
    "refinements": 2,
}  # so many of the first of `_kinds`
_NUMBERS: list[tuple[str, Any]] = [
    ("text", "rubbish"),
    ("infinite", float("inf")),
    ("huge", HUGE),
    ("negative", -1),
    ("zero", 0),
    ("most negative", -HUGE),
    ("a fraction", 1.5),
    ("blob", b"\xff\x00"),
    ("1e300", 1e300),
    ("minus infinite", float("-inf")),
    ("nothing there", NOTHING),
]
_TEXTS: list[tuple[str, Any]] = [
    ("no UTF-8", b"\xff\xfe"),
    ("empty", ""),
    ("long", "x" * 300_000),
    ("deep", "[" * 4000),
    ("deeper", "[" * 200_000),
    ("400 digits", "[" + "9" * 400 + "]"),
    ("infinite numbers", "[1e999, -1e999, NaN, 0]"),
    ("an object", '{"a": {"score_threshold": []}, "max_keypoints": "x", "classes": 7, "score_threshold": "y"}'),
    ("null", "null"),
    ("control characters", "\x1b[31m\n\x00\u202e"),
]
_BLOBS: list[tuple[str, Any]] = [
    ("text", "rubbish"),
    ("half", lambda data: data[: len(data) // 2]),
    ("empty", b""),
    ("number", 10**12),
    ("twice", lambda data: data * 2),
    ("a bit", lambda data: data[:-3] + bytes([data[-3] ^ 64]) + data[-2:]),
    ("header only", lambda data: data[:12]),
    ("zeros", b"\0" * 4096),
    ("other array", lambda _: encode_array(np.ones(3, "<f8"))),
    ("many dimensions", lambda _: _array((0, 2**32 - 1, 2**32 - 1), b"")),
    ("no numbers", lambda _: encode_array(np.empty(0, "<f4"))),
]


def _kinds(table: Table, column: str, kind: Any) -> list[tuple[str, Any]]:
    special = _SPECIAL.get((table.name, column), [])
    if isinstance(kind, LargeBinary):
        return [*special, *_BLOBS]
    if isinstance(kind, TypeDecorator | DateTime):
        return [*special, ("rubbish", "yesterday"), ("number", 7), ("blob", b"\xff"), ("far", "99999-01-01 00:00:00")]
    if isinstance(kind, String | Text):
        return [*special, *_TEXTS]
    if isinstance(kind, Double):
        return [*special, *_NUMBERS[1::-1], *_NUMBERS[2:]]
    assert isinstance(kind, Integer), kind
    return [*special, *_NUMBERS]


def _array(shape: tuple[int, ...], data: bytes) -> bytes:
    """A blob whose checksum is right, whatever else."""
    import zlib

    head = struct.pack("<4sBBBB", b"SDBA", 1, 1, len(shape), 0)
    rest = struct.pack(f"<{len(shape)}I", *shape) + data
    return head + struct.pack("<I", zlib.crc32(rest, zlib.crc32(head))) + rest


def _changed(change: Callable[[Any], Any]) -> Callable[[bytes], bytes]:
    """A blob with other numbers, its checksum right."""

    def damaged(data: bytes) -> bytes:
        numbers = decode_array(data, "here", magic=data[:4]).copy()
        return encode_array(np.ascontiguousarray(change(numbers)), magic=data[:4])

    return damaged


def _with(place: Any, value: float) -> Callable[[Any], Any]:
    def change(numbers: Any) -> Any:
        numbers[place] = value
        return numbers

    return change


_SPECIAL: dict[tuple[str, str], list[tuple[str, Any]]] = {
    ("descriptors", "data"): [
        ("!narrow", _changed(lambda a: a[:, :8])),
        ("!every", _changed(lambda a: a[:, :4])),
        ("!no columns", _changed(lambda a: a[:, :0])),
        ("!fewer", _changed(lambda a: a[:-7])),
        ("!none", _changed(lambda a: a[:0])),
        ("wide", _changed(lambda a: np.tile(a, (1, 40)))),
        ("float", _changed(lambda a: a.astype("<f4"))),
        ("not finite", _changed(lambda a: np.full((len(a), 32), np.nan, "<f4"))),
        ("one row long", _changed(lambda a: a.reshape(1, -1))),
    ],
    ("keypoints", "data"): [
        ("!far outside", _changed(_with((slice(None), 0), 1e9))),
        ("!not a number", _changed(_with((0, 1), np.nan))),
        ("!more", _changed(lambda a: np.tile(a, (3, 1)))),
        ("!none", _changed(lambda a: a[:0])),
        ("negative", _changed(_with((slice(None), slice(0, 2)), -1e30))),
        ("infinite size", _changed(_with((1, 2), np.inf))),
        ("infinite point", _changed(_with((slice(None), 8), np.inf))),
        ("far point", _changed(_with((slice(None), 6), 1e30))),
        ("sign", _changed(_with((slice(None), 5), 300))),
        ("eight columns", _changed(lambda a: a[:, :8])),
        ("compact without end", lambda _: encode_array(np.full(26 + 8 * 9, 65535, "<u2"), magic=b"SDBK")),
        ("compact and not finite", lambda _: encode_array(np.full(26 + 8 * 200, 0x7F80, "<u2"), magic=b"SDBK")),
    ],
    ("cnn_vectors", "vector"): [
        ("!short", _changed(lambda a: a[:5])),
        ("!not a number", _changed(_with(3, np.nan))),
        ("huge numbers", _changed(_with(slice(None), 3e38))),
        ("long", _changed(lambda a: np.tile(a, 9))),
        ("infinite", _changed(_with(0, -np.inf))),
    ],
    ("objects", "mask"): [
        ("!gigapixels", lambda _: encode_array(np.array([60000, 60000, 3_600_000_000], "<u4"), magic=MASK_MAGIC)),
        ("!other size", lambda _: encode_array(np.array([2, 2, 4], "<u2"), magic=MASK_MAGIC)),
        ("runs", lambda _: encode_array(np.array([120, 160, 5, 5], "<u2"), magic=MASK_MAGIC)),
    ],
    ("refined_points", "data"): [
        ("!fewer", _changed(lambda a: a[:3])),
        ("infinite", _changed(_with((slice(None), 2), np.inf))),
        ("far", _changed(_with((slice(None), slice(0, 3)), 1e30))),
        ("sigma", _changed(_with((slice(None), slice(None)), -1.0))),
    ],
    ("keyframe_images", "rgb"): [
        ("!large picture", lambda _: _png(65000, 65000)),
        ("other picture", lambda _: _png(4000, 3000)),
    ],
    ("keyframes", "tx"): [("!far", 1e12), ("!infinite", float("inf")), ("farther", 1e15), ("!every", 1e15)],
    ("keyframes", "qw"): [("!zero", 0.0), ("long", 1e6), ("!infinite", float("inf"))],
    ("cameras", "fx"): [("!zero", 0.0), ("!infinite", float("inf")), ("tiny", 1e-300)],
    ("cameras", "width"): [("!huge", 2**31 - 1), ("narrow", 3), ("65535", 65535)],
    ("cameras", "distortion"): [
        ("!nested", "[[1, 2], [3]]"),
        ("!no JSON", "k1=0"),
        ("folding", "[-1e5, 1e5, 1e5, 1e5]"),
    ],
    ("models", "config"): [("!no JSON", "{config"), ("!list", "[]"), ("!types", _TEXTS[7][1])],
    ("refinements", "parameters"): [("!no JSON", "{"), ("!list", "[]")],
}


def _png(width: int, height: int) -> bytes:
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def apply(file: Path, damage: Damage) -> int:
    """Writes it, whatever keys say. Returns how many rows were changed."""
    with closing(sqlite3.connect(file)) as connection:
        connection.execute("PRAGMA foreign_keys = OFF")
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.text_factory = bytes
        rows = connection.execute(f"SELECT rowid, {damage.column} FROM {damage.table} ORDER BY 1 LIMIT 200").fetchall()
        chosen = rows if damage.every else rows[1:2] or rows[:1]
        done = 0
        for rowid, before in chosen:
            value = damage.value(before) if callable(damage.value) and before is not None else damage.value
            if callable(value):
                continue
            text = isinstance(value, bytes) and damage.what == "no UTF-8"
            place = "CAST(? AS TEXT)" if text else "?"
            try:
                connection.execute(
                    f"UPDATE {damage.table} SET {damage.column} = {place} WHERE rowid = ?", (value, rowid)
                )
                done += 1
            except (sqlite3.IntegrityError, sqlite3.OperationalError):
                continue  # SQLite itself refuses it: a row id that is no number, a key that is there twice
        connection.commit()
        return done


class Reader:
    """All that reads a database, with one description of a query."""

    def __init__(self, folder: Path, thick: bool) -> None:
        self.folder, self.thick, self.settings = folder, thick, settings(folder)
        self.found: Localization | None = None
        self.query = sorted((folder / "room" / "rgb").iterdir())[5]
        with open_store(self.settings.database_url) as store:
            models = store.map_models(1)
            camera = store.cameras(1)[0]
        specs = specs_for_query(self.settings, models)
        own = settings_of_map(self.settings, models)
        self.models, self.describer = models, describer_from_specs(specs.detector, specs.encoder, specs.features, own)
        self.image = QueryReader(camera=camera).read(self.query)
        self.description: Description = self.describer.describe(
            self.image.image, self.image.depth, self.image.camera, self.image.instances
        )

    def operations(self, table: str) -> dict[str, Callable[[Store], Any]]:
        found: dict[str, Callable[[Store], Any]] = {"status": self.status, "sql": self.sql}
        if table in OF_KEYFRAMES or self.thick:
            found["keypoints"] = self.keypoints
        for name, operation in (("index", self.index), ("plot", self.plot), ("refine", self.refine)):
            if table in _READ_BY[name] or (self.thick and table in _READ_TOO[name]):
                found[name] = operation
        return found

    def status(self, store: Store) -> Any:
        with semdb.open(f"sqlite:///{store.engine.url.database}", say=store.say) as database:
            database.workers()
            database.unsent()
            found = database.status()
            refined = status_command.refinements_of(found.refinements)
        return [status_command.as_json(item, found.failed, refined.get(item.map_id, {})) for item in found.recordings]

    def sql(self, store: Store) -> Localization:
        self.found = None
        self.found = self._localize(store, "sql")
        return self.found

    def index(self, store: Store) -> Localization:
        return self._localize(store, "index")

    def _localize(self, store: Store, coarse: str) -> Localization:
        """As `localize_images`, whose networks take longer than all the rest."""
        store.maps()
        info = next((head for head in store.map_heads() if head.holds_keyframes), None)
        if info is None:
            raise NotFoundError("the database holds no keyframe")
        if info.damage:
            raise CodecError(info.damage)
        specs_for_query(self.settings, info.models)
        settings_of_map(self.settings, info.models)
        check_models(info.models, self.models, "the map")
        localizer = make_localizer(store, info, coarse, settings=self.settings, say=store.say)
        store.cameras(info.id)
        found = localizer.localize(self.description)
        store.log_query(info.id, "query", found)
        return found

    def plot(self, store: Store) -> Any:
        """Of what `sql` found."""
        found = self.found
        if found is None:
            return None
        if self.thick:
            return pictures.draw_picture(store, self.image, self.description.detections, found).shape
        pictures._keyframe(store, found)
        return pictures._top_view(store, self.image, found, ["chair"]).shape

    def keypoints(self, store: Store) -> int:
        total = 0
        failure: SemdbError | None = None
        for keyframe_id in range(1, KEYFRAMES + 1):
            try:
                (loaded,) = store.load_keyframes([keyframe_id], descriptors=False)
                total += len(loaded.keypoints)
                image: StoredImage = store.load_image(keyframe_id)
                store.load_masks(keyframe_id)
                total += len(image.rgb)
            except (CodecError, NotFoundError) as error:
                failure = failure or error
        with semdb.open(f"sqlite:///{store.engine.url.database}", say=store.say) as database:
            for keyframe in database.keyframes("m", limit=2):
                total += len(keyframe.objects) + len(keyframe.keypoints)
        if failure is not None:
            raise failure
        return total

    def refine(self, store: Store) -> Any:
        kinds = FOR_LOCALIZATION  # landmarks take as long as all else
        results = [refine_map(store, info, kinds=kinds, force=True) for info in store.maps() if info.keyframes]
        return [result.rows for found in results for result in found]


def main(folder: Path, thick: bool, part: int = 0, parts: int = 1) -> None:
    reader = Reader(folder, thick)
    whole, damaged = folder / "whole.sqlite3", folder / f"damaged-{part}.sqlite3"
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for number, damage in enumerate(damages(thick)):
        if number % parts != part:
            continue
        shutil.copy(whole, damaged)
        rows = apply(damaged, damage)
        for name, operation in reader.operations(damage.table).items() if rows else ():
            say({"at": str(damage), "operation": name})
            said: list[str] = []
            outcome, began = "done", time.perf_counter()
            try:
                with open_store(f"sqlite:///{damaged}", say=said.append) as store:
                    found = operation(store)
                    if isinstance(found, Localization):
                        outcome = str(found.verdict)
            except SemdbError as error:
                outcome = f"error: {error}"
            except Exception:
                outcome = f"TRACEBACK: {traceback.format_exc()[-1500:]}"
            seconds = time.perf_counter() - began
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            say(
                {
                    "table": damage.table,
                    "column": damage.column,
                    "what": damage.what,
                    "every": damage.every,
                    "operation": name,
                    "outcome": outcome,
                    "said": said,
                    "seconds": round(seconds, 3),
                    "grown_mib": (peak - before) // 1024,
                }
            )


def say(line: dict[str, Any]) -> None:
    print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2] == "thick", *map(int, sys.argv[3:]))
