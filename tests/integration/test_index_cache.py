"""The files of an index: used when they are this database's, built anew and told of when not."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text, update

from semdb.database import retry, schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.database.tables import cnn_vectors, keyframe_changes
from semdb.localization.index import IndexOptions, IndexSource, MapIndex
from semdb.localization.index import cache_folder as cache_module
from semdb.localization.index import map_index as index_module
from semdb.localization.sources import SqlSource
from semdb.types import Float32Array, Int64Array
from tests.database_samples import fill
from tests.integration.test_index import EXACT, REDUCED, assert_same, redescribe


def files(folder: Path, pattern: str) -> list[Path]:
    return sorted(folder.glob(f"index/*/*/{pattern}"))


def open_again(
    store: Store, map_id: int, folder: Path, options: IndexOptions = EXACT
) -> tuple[MapIndex, list[str], bool]:
    """The index, what was said, and whether the whole map was read from the database."""
    said: list[str] = []
    read: list[int] = []
    iter_vectors = store.iter_vectors

    def counted(*arguments: int, **how: Any) -> Iterator[tuple[Int64Array, Float32Array]]:
        read.append(1)
        return iter_vectors(*arguments, **how)

    store.iter_vectors = counted  # type: ignore[method-assign, assignment]
    try:
        index = MapIndex.open(store, map_id, folder, options=options, say=said.append)
    finally:
        store.iter_vectors = iter_vectors  # type: ignore[method-assign]
    return index, said, bool(read)


def assert_right(store: Store, map_id: int, index: MapIndex) -> None:
    source, sql = IndexSource(index), SqlSource(store, map_id)
    source.refresh()
    sql.refresh()
    assert_same(source, sql, 7, queries=2)


@pytest.mark.parametrize("options", [EXACT, REDUCED], ids=["exact", "reduced"])
def test_the_next_start_reads_files_and_what_changed_since(store: Store, tmp_path: Path, options: IndexOptions) -> None:
    map_id, _, ids = fill(store, frame_indexes=range(20))
    _, said, read = open_again(store, map_id, tmp_path, options)
    assert (said, read) == ([], True)
    index, said, read = open_again(store, map_id, tmp_path, options)
    assert (said, read) == ([], False)
    assert (index.state.reduction is not None) == (options is REDUCED)
    store.delete_keyframes(ids[2:5])
    redescribe(store, map_id, ids[7], 3)
    fill(store, name="second", frame_indexes=range(3), seed=90)
    index, said, read = open_again(store, map_id, tmp_path, options)
    assert (said, read) == ([], False)
    assert_right(store, map_id, index)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-10])


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) * 2 // 3] ^= 1
    path.write_bytes(data)


def empty(path: Path) -> None:
    path.write_bytes(b"")


def other_version(path: Path) -> None:
    path.write_bytes(b"SDBINDX0" + path.read_bytes()[8:])


@pytest.mark.parametrize(
    ("pattern", "damage", "told"),
    [
        ("index.sdb", truncate, "truncated"),
        ("index.sdb", flip, "damaged"),
        ("index.sdb", empty, "truncated"),
        ("index.sdb", other_version, "another kind or version"),
        ("vectors-*.f32", truncate, "truncated"),
        ("vectors-*.f32", flip, "damaged"),
        ("vectors-*.f32", empty, "not what the index names"),
        ("vectors-*.f32", Path.unlink, "missing"),
    ],
)
def test_a_broken_file_is_told_of_and_built_anew(
    tmp_path: Path, pattern: str, damage: Callable[[Path], None], told: str
) -> None:
    with open_store(f"sqlite:///{tmp_path / 'a.sqlite3'}", create=True) as store:
        map_id, _, _ = fill(store, frame_indexes=range(6))
        open_again(store, map_id, tmp_path)
        (path,) = files(tmp_path, pattern)
        damage(path)
        index, said, read = open_again(store, map_id, tmp_path)
        assert read
        assert len(said) == 1
        assert told in said[0]
        assert_right(store, map_id, index)
        assert open_again(store, map_id, tmp_path)[1:] == ([], False)


def test_a_database_that_was_made_anew_is_noticed(store: Store, database_url: str, tmp_path: Path) -> None:
    """The same URL, ids and names, other rows."""
    map_id, _, _ = fill(store, frame_indexes=range(6))
    open_again(store, map_id, tmp_path)
    store.close()
    engine = make_engine(database_url)
    if engine.dialect.name == "sqlite":
        engine.dispose()
        for path in Path(engine.url.database or "").parent.glob(f"{Path(engine.url.database or '').name}*"):
            path.unlink()
    else:
        name = engine.url.database
        with engine.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name}"))
            connection.execute(text(f"CREATE DATABASE {name} CHARACTER SET utf8mb4 COLLATE utf8mb4_bin"))
        engine.dispose()
    schema.upgrade(make_engine(database_url))
    with open_store(database_url) as again:
        assert fill(again, frame_indexes=range(6), seed=500)[0] == map_id
        index, said, read = open_again(again, map_id, tmp_path)
        assert read
        assert len(said) == 1
        assert_right(again, map_id, index)


def test_rows_that_changed_behind_the_log_are_noticed(store: Store, tmp_path: Path) -> None:
    """A backup that was put back, or statements of somebody's own: sums and samples do not agree."""
    map_id, _, ids = fill(store, frame_indexes=range(6))
    open_again(store, map_id, tmp_path)
    other = store.load_vectors(ids[1:2])[0]
    from semdb.database.codecs import encode_array

    change = update(cnn_vectors).where(cnn_vectors.c.keyframe_id == ids[0]).values(vector=encode_array(other))
    retry.write(store.engine, lambda connection: connection.execute(change))
    index, said, read = open_again(store, map_id, tmp_path)
    assert read
    assert "does not agree with the database" in said[0]
    assert_right(store, map_id, index)


def test_a_log_that_was_cut_off_means_a_closer_look(store: Store, tmp_path: Path) -> None:
    map_id, _, _ = fill(store, frame_indexes=range(6))
    index, _, _ = open_again(store, map_id, tmp_path)
    source = IndexSource(index)
    fill(store, name="second", frame_indexes=range(3), seed=70)
    retry.write(store.engine, lambda connection: connection.execute(keyframe_changes.delete()))
    assert source.refresh().everything  # nine keyframes where six were known, and no word about three
    assert source.keyframe_count() == 9
    assert_right(store, map_id, index)
    assert open_again(store, map_id, tmp_path)[1:] == ([], False)


def test_a_folder_that_cannot_be_used_is_told_of_and_done_without(store: Store, tmp_path: Path) -> None:
    map_id, _, _ = fill(store, frame_indexes=range(6))
    (tmp_path / "cache").write_text("a file, not a folder")
    index, said, read = open_again(store, map_id, tmp_path / "cache")
    assert read
    assert len(said) == 1
    assert "in memory alone" in said[0]
    assert_right(store, map_id, index)


def test_a_disk_that_is_full_is_told_of_and_done_without(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    map_id, _, _ = fill(store, frame_indexes=range(6))

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache_module, "write_vectors", full)
    index, said, _ = open_again(store, map_id, tmp_path)
    assert "No space left" in said[0]
    assert_right(store, map_id, index)


def test_two_processes_may_use_one_folder(store: Store, tmp_path: Path) -> None:
    map_id, _, ids = fill(store, frame_indexes=range(12))
    first, _, _ = open_again(store, map_id, tmp_path)
    second, _, _ = open_again(store, map_id, tmp_path)
    store.delete_keyframes(ids[:5])
    for index in (first, second):
        index.refresh()
        index.close()  # each writes what it has; the later one stays
    assert len(files(tmp_path, "index.sdb")) == 1
    fill(store, name="second", frame_indexes=range(3), seed=70)
    for index in (first, second):
        assert_right(store, map_id, index)
    third, said, read = open_again(store, map_id, tmp_path)
    assert (said, read) == ([], False)
    assert_right(store, map_id, third)


def test_files_that_no_index_names_go_when_they_are_old(store: Store, tmp_path: Path) -> None:
    map_id, _, ids = fill(store, frame_indexes=range(12))
    index, _, _ = open_again(store, map_id, tmp_path)
    (vectors,) = files(tmp_path, "vectors-*.f32")
    abandoned = vectors.with_name("vectors-" + "0" * 32 + ".f32")
    for path in (abandoned, vectors.with_name("index.sdb.1-abc.tmp")):
        path.write_bytes(b"left by a process that was killed")
        os.utime(path, (0, 0))
    young = vectors.with_name("vectors-" + "1" * 32 + ".f32")
    young.write_bytes(b"of another process, which will name it in a moment")
    store.delete_keyframes(ids[:2])
    index.refresh()
    index.close()
    assert {path.name for path in files(tmp_path, "*")} == {"index.sdb", vectors.name, young.name}


def test_dead_rows_and_many_small_files_are_cleared_away(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Appended vectors go to files of their own, small files become one, and a state in use stays as it was."""
    monkeypatch.setattr(index_module, "FLUSH_ROWS", 2)
    monkeypatch.setattr(cache_module, "MOST_PARTS", 3)
    map_id, _, ids = fill(store, frame_indexes=range(12))
    for options in (EXACT, REDUCED):
        index, _, _ = open_again(store, map_id, tmp_path, options)
        source = IndexSource(index)
        vector = store.load_vectors(ids[-1:])[0]
        before = source.nearest(vector, 100, None, 0.0)
        for number in range(5):
            fill(store, name=f"{options.exact_up_to} {number}", frame_indexes=range(2), seed=100 * number)
            index.refresh()
            assert len(index.state.vectors.parts) <= 4
        assert_right(store, map_id, index)
        store.delete_keyframes(store.keyframe_ids(map_id)[3:14])
        index.refresh()
        assert index.state.living == len(index.state.ids)
        assert_right(store, map_id, index)
        held = source.nearest(vector, 100, None, 0.0)
        assert np.array_equal(held.keyframe_ids, before.keyframe_ids)
        assert np.array_equal(held.cosines, before.cosines)
        ids = store.keyframe_ids(map_id)
