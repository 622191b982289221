"""Rows that semdb cannot have written: said, left out where the rest can serve, and never the end of a process."""

from __future__ import annotations

import contextlib
import json
import re
import sqlite3
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text

from semdb.database import refinements, tables
from semdb.database.codecs import MASK_MAGIC, decode_array, encode_array
from semdb.database.left_out import MOST_SAID, LeftOut
from semdb.database.store import Store, open_store
from semdb.errors import CodecError, DatabaseError, NotFoundError, UsageError
from semdb.geometry import pose_from
from semdb.localization.index import MapIndex
from semdb.localization.index.source import IndexSource
from semdb.localization.sources import SqlSource
from tests import damage
from tests.database_samples import description, fill, plan, pose, record

PROCESSES, PARTS = 2, 4  # of the thin damages, half are tried; all are among the thick ones
MOST_GROWN_MIB = 400
# What the fine step reads of a keyframe, or the ranking: where it is none, nobody may go on in silence.
NOTICED = {
    "cameras": {"width", "height", "fx", "fy", "cx", "cy", "distortion"},
    "cnn_vectors": {"vector"},
    "descriptors": {"data"},
    "keyframe_categories": {"count", "upper_strength", "lower_strength"},
    "keyframes": {"frame_index", "timestamp_ns", "qw", "qx", "qy", "qz", "tx", "ty", "tz"},
    "keypoints": {"count", "data"},
    "object_features": {"start", "count"},
    "objects": {"ordinal", "score", "x1", "y1", "x2", "y2", "pixel_area", "centroid_x", "extent_z"},
}
RIGHT_AFTER_ALL = {  # as a value of that column, or among others that are like it
    ("descriptors.data", "!every"),
    ("keyframes.timestamp_ns", "huge"),
    ("keyframes.timestamp_ns", "negative"),
    ("keyframes.timestamp_ns", "zero"),
    ("keyframes.timestamp_ns", "most negative"),
    ("keyframes.timestamp_ns", "nothing there"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("damaged")
    damage.make(folder)
    return folder


def run(folder: Path, depth: str) -> list[dict[str, Any]]:
    """What each operation on each damaged database came to; fails where a process ended otherwise than by itself."""
    processes = []
    for part in range(PROCESSES):
        command = [
            sys.executable,
            "-m",
            "tests.damage",
            str(folder),
            depth,
            str(part),
            str(PARTS if depth == "thin" else PROCESSES),
        ]
        with (folder / f"{part}.out").open("w") as out:
            processes.append(subprocess.Popen(command, stdout=out, stderr=subprocess.PIPE, text=True))
    lines = []
    for part, process in enumerate(processes):
        stderr = process.communicate()[1]
        said = [json.loads(line) for line in (folder / f"{part}.out").read_text().splitlines()]
        assert process.returncode == 0, f"ended with {process.returncode} at {said[-1:]}: {stderr[-2000:]}"
        assert not re.search("warning", stderr, re.IGNORECASE), stderr[:2000]
        lines += [line for line in said if "outcome" in line]
    return lines


def check(lines: list[dict[str, Any]]) -> None:
    outcomes = Counter(line["outcome"].partition(":")[0] for line in lines)
    assert set(outcomes) <= {"done", "localized", "ambiguous", "failed", "error"}, [
        line for line in lines if line["outcome"].startswith("TRACEBACK")
    ][:3]
    known = "|".join(name.removesuffix("s") for name in tables.metadata.tables)
    for line in lines:
        assert line["grown_mib"] < MOST_GROWN_MIB, line
        if line["outcome"].startswith("error"):
            assert "\n" not in line["outcome"], line
            assert len(line["outcome"]) < 600, line
            holds_nothing = "holds no keyframe" in line["outcome"] or "there is no" in line["outcome"]
            assert holds_nothing or re.search(known, line["outcome"]), line
        for remark in line["said"]:
            assert re.search(known, remark), line
            assert len(remark) < 600, line


def test_no_damaged_column_ends_a_process(whole: Path) -> None:
    lines = run(whole, "thin")
    check(lines)
    assert len(lines) > 150
    silent = []
    for line in lines:
        name = f"{line['table']}.{line['column']}"
        if line["column"] not in NOTICED.get(line["table"], ()) or (name, line["what"]) in RIGHT_AFTER_ALL:
            continue
        if line["operation"] in ("sql", "index", "refine") and not line["outcome"].startswith("error"):
            if line["operation"] == "refine" and line["table"] in ("cnn_vectors", "keyframe_categories"):
                continue
            if not line["said"]:
                silent.append((name, line["what"], line["operation"]))
    assert silent == []
    # One keyframe of four is damaged: the others give the pose.
    one = [line for line in lines if line["operation"] in ("sql", "index") and line["table"] in NOTICED]
    served = [line for line in one if line["outcome"] in ("localized", "ambiguous")]
    assert len(served) >= 0.7 * len(one)


@pytest.mark.long
def test_no_damage_of_any_kind_ends_a_process(whole: Path) -> None:
    check(run(whole, "thick"))


def test_a_damaged_keyframe_is_left_out_on_every_server(store: Store) -> None:
    """What servers let in, too: blobs of any content, any number, any text."""
    map_id, _, ids = fill(store)
    other = fill(store, "hall", "another", frame_indexes=(1, 2), seed=50)
    said: list[str] = []
    store.left_out, store.say = LeftOut(said.append), said.append
    whole = store.load_keyframes(ids)

    def change(table: str, key: str, number: int, **values: Any) -> None:
        columns = ", ".join(f"{name} = :{name}" for name in values)
        with store.engine.begin() as connection:
            done = connection.execute(
                text(f"UPDATE {table} SET {columns} WHERE {key} = :the_key"), {**values, "the_key": number}
            )
            assert done.rowcount >= 1

    def blob(table: str, column: str, number: int) -> bytes:
        with store.engine.connect() as connection:
            query = f"SELECT {column} FROM {table} WHERE keyframe_id = {number}"
            return bytes(connection.execute(text(query)).scalar_one())

    narrow = encode_array(np.ascontiguousarray(decode_array(blob("descriptors", "data", ids[0]), "x")[:-9]))
    change("descriptors", "keyframe_id", ids[0], data=narrow)
    points = decode_array(blob("keypoints", "data", ids[1]), "x").copy()
    points[5, 0] = 1e9
    change("keypoints", "keyframe_id", ids[1], data=encode_array(points))
    change("keyframes", "id", ids[2], tx=1e15)
    change("cnn_vectors", "keyframe_id", ids[3], vector=encode_array(np.full(128, 7, "<f4")))
    assert [known.id for known in store.load_keyframes(ids, bad=store.left_out)] == ids[3:]
    assert len(said) == 3
    assert said[0] == (
        f"what is damaged of keyframe {ids[0]} is left out: descriptors.data of keyframe {ids[0]}: 51 descriptors for "
        f"60 keypoints (semdb delete keyframes {ids[0]} removes it)"
    )
    assert "keypoint 5 is at (1e+09, " in said[1]
    assert "tx" not in said[2]
    assert f"the pose of keyframe {ids[2]} is (" in said[2]
    with pytest.raises(CodecError, match=f"^descriptors.data of keyframe {ids[0]}"):
        store.load_keyframes([ids[0]])
    assert store.load_keyframes(ids[3:])[0].world_from_camera.tolist() == whole[3].world_from_camera.tolist()

    found, poses = store.poses(map_id, bad=store.left_out)
    assert found == [*ids[:2], *ids[3:]]
    np.testing.assert_allclose(poses[2], pose(12), atol=1e-12)
    with pytest.raises(CodecError, match=f"the pose of keyframe {ids[2]}"):
        store.poses(map_id)
    keys, vectors = store.vectors_there(np.array(ids, np.int64), bad=store.left_out)
    assert keys.tolist() == ids
    assert not vectors[3].any()
    assert "cnn_vectors.vector" in said[-1]
    assert len(said) == 4
    with pytest.raises(CodecError, match=f"cnn_vectors.vector of keyframe {ids[3]}"):
        store.load_vectors(ids)

    query = description(3)
    with MapIndex.open(store, map_id) as index:  # both sources rank the others alike
        sources = (SqlSource(store, map_id), IndexSource(index))
        ranked = [source.nearest(query.cnn_vector, 5, None, 0.0) for source in sources]
    assert ranked[0].keyframe_ids.tolist() == ranked[1].keyframe_ids.tolist()
    assert sorted(ranked[0].keyframe_ids.tolist()) == sorted(ids)
    assert ranked[0].cosines.tolist() == ranked[1].cosines.tolist()

    state = store.map_state(map_id)
    assert state == store.map_state(map_id)
    assert len(store.status()) == 2
    objects = list(store.iter_objects(map_id, bad=store.left_out))
    assert {item.keyframe for item in objects} <= {0, 1, 3, 4}
    assert len(said) == 4  # each once
    change("cameras", "id", 1, distortion='{"k1": [1]}')
    assert store.cameras(map_id) == []
    assert said[-1].startswith("a camera is left out: cameras.distortion of camera 1 is '{\"k1\": [1]}', not a list")
    assert store.load_keyframes(ids + other[2], bad=store.left_out) == []
    store.check_keyframes(ids)
    with pytest.raises(NotFoundError, match="there is no keyframe 999"):
        store.check_keyframes([*ids, 999])
    assert store.delete_keyframes(ids) == 5
    assert store.map_state(map_id) == "0 0 0 0"


def test_masks_have_the_size_of_the_camera(store: Store) -> None:
    _, _, ids = fill(store)
    assert {mask.shape for mask in store.load_masks(ids[0])} == {(48, 64)}
    with store.engine.begin() as connection:
        huge = encode_array(np.array([60000, 60000, 3_600_000_000], "<u4"), magic=MASK_MAGIC)
        connection.execute(text("UPDATE objects SET mask = :mask WHERE ordinal = 0"), {"mask": huge})
    with pytest.raises(
        CodecError, match=r"objects.mask of object \d+ \(keyframe 1\): a mask of 60000x60000 pixels, but"
    ):
        store.load_masks(ids[0])


def test_a_map_whose_poses_are_absurd_has_a_state(store: Store) -> None:
    """Ingested before there was a bound: the sum that tells states apart overflows on no server."""
    map_id, _, ids = fill(store)
    usual = store.map_state(map_id)
    assert usual == " ".join(map(str, _state_of(store, ids)))
    with store.engine.begin() as connection:
        connection.execute(text("UPDATE keyframes SET tx = 9.9e7, ty = -9.9e7, tz = 9.9e7"))
    far = store.map_state(map_id)
    assert far == " ".join(map(str, _state_of(store, ids)))
    for value in (1e12, 1e15, 1e300, -1e15):
        with store.engine.begin() as connection:
            connection.execute(
                text("UPDATE keyframes SET tx = :value WHERE id = :key"), {"value": value, "key": ids[0]}
            )
        assert store.map_state(map_id) not in (usual, far)
        store.replace_refinement(map_id, "classes", store.map_state(map_id), {}, refinements.replace_confusions, [])
        assert store.refinements(map_id)[0].current
        assert store.status()[0].keyframes == 5


def _state_of(store: Store, ids: list[int]) -> tuple[int, int, int, int]:
    total = 0
    with store.engine.connect() as connection:
        for w, x, y, z, a, b, c in connection.execute(text("SELECT qw, qx, qy, qz, tx, ty, tz FROM keyframes")):
            mixed = (w + 2 * x + 3 * y + 5 * z + 7 * a + 11 * b + 13 * c) * 1_000_000
            total += int(np.floor(abs(mixed) + 0.5) * np.sign(mixed))
    return len(ids), max(ids), sum(ids), total


def test_absurd_poses_are_not_stored(store: Store) -> None:
    from dataclasses import replace

    map_id = store.ensure_map("room")
    planned = store.plan_recording(map_id, plan("first", [0, 1]), description(0).models)
    for place in (2e8, -1e12, 1e300):
        absurd = replace(record(0, description(0)), world_from_camera=pose_from(np.eye(3), [0.0, place, 0.0]))
        with pytest.raises(UsageError, match="at most 1e\\+08 m from the origin of its map"):
            store.write_keyframe(planned.recording_id, absurd)
    far = replace(record(1, description(1)), world_from_camera=pose_from(np.eye(3), [5e5, 9.9e6, 400.0]))  # UTM
    key = store.write_keyframe(planned.recording_id, far).keyframe_id
    assert store.load_keyframes([key])[0].world_from_camera[:3, 3].tolist() == [5e5, 9.9e6, 400.0]


def test_not_every_damaged_keyframe_is_named() -> None:
    said: list[str] = []
    left_out = LeftOut(said.append)
    for turn in range(2):
        for key in range(30):
            left_out(key, CodecError("x"))
        assert len(said) == MOST_SAID + 1, turn
    assert said[-1] == "of more keyframes something is damaged and left out; the first 10 are named above"


def test_a_damaged_page_amid_vectors_is_an_error_of_the_database(tmp_path: Path) -> None:
    """SQLite finds it while rows are fetched, after the statement has begun."""
    path = tmp_path / "semdb.sqlite3"
    with open_store(f"sqlite:///{path}", create=True) as store:
        map_id, _, ids = fill(store, frame_indexes=range(12))
    vector = encode_array(np.eye(1, 700, dtype=np.float32)[0])
    with contextlib.closing(sqlite3.connect(path)) as connection:
        connection.execute("UPDATE cnn_vectors SET vector = ?", (vector,))
        connection.commit()
        connection.execute("VACUUM")
        connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        (size,) = connection.execute("PRAGMA page_size").fetchone()
        (root,) = connection.execute("SELECT rootpage FROM sqlite_master WHERE name = 'cnn_vectors'").fetchone()
    data = bytearray(path.read_bytes())
    page = data[(root - 1) * size : root * size]
    cells = int.from_bytes(page[3:5], "big")
    assert (page[0], cells) == (5, len(ids) - 1)  # of pages of the table, each with a row
    at = int.from_bytes(page[12 + 2 * (cells - 1) :][:2], "big")
    last = int.from_bytes(page[at : at + 4], "big")
    data[(last - 1) * size : last * size] = b"\xaa" * size
    path.write_bytes(data)
    with open_store(f"sqlite:///{path}") as store, pytest.raises(DatabaseError, match="is damaged"):
        list(store.iter_vectors(map_id))
