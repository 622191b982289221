"""`semdb ingest --redescribe encoder`: vectors by another encoder, switched all at once, whatever happens meanwhile."""

from __future__ import annotations

import dataclasses
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from sqlalchemy import func, select, update
from typer.testing import CliRunner

import semdb
from semdb.cli.main import app
from semdb.database import encodings, retry, tables
from semdb.database.copying import copy_map
from semdb.database.records import ChangeKind, ItemState, MapInfo
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError, ProvenanceError, RecordingError, UsageError
from semdb.ingestion import redescribe
from semdb.ingestion.redescribe import redescribe_map
from semdb.localization.index import IndexSource, MapIndex
from semdb.localization.sources import SqlSource
from semdb.perception.encoders.gist import GistEncoder
from semdb.settings import Settings
from tests.database_samples import MODELS, description, plan, record

FRAMES = range(10)
GIST = GistEncoder().info


def image(index: int) -> np.ndarray:
    rng = np.random.default_rng(index)
    small = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    return np.ascontiguousarray(cv2.resize(small, (64, 48), interpolation=cv2.INTER_CUBIC))


def png(index: int) -> bytes:
    return cv2.imencode(".png", image(index)[:, :, ::-1])[1].tobytes()


def frame(index: int) -> Any:
    return dataclasses.replace(record(index, description(index, keypoints=8)), image_bytes=png(index))


def filled(store: Store) -> MapInfo:
    """A map whose keyframes have images that can be read."""
    planned = store.plan_recording(store.ensure_map("m"), plan("visit", [*FRAMES, 90]), MODELS)
    for index in FRAMES:
        store.write_keyframe(planned.recording_id, frame(index))
    return store.find_map("m")


def vectors(store: Store, info: MapInfo) -> np.ndarray:
    found = [piece for _, piece in store.iter_vectors(info.id)]
    np.testing.assert_array_equal(np.concatenate(found), store.load_vectors(store.keyframe_ids(info.id)))
    return np.concatenate(found)


def rows(store: Store) -> int:
    count = select(func.count()).select_from(tables.cnn_vectors)
    return int(retry.read(store.engine, lambda connection: connection.execute(count).scalar()))


def expected() -> np.ndarray:
    encoder = GistEncoder()
    return np.stack([encoder.encode(image(index)) for index in FRAMES])


WANTED = Settings(encoder="gist")


class Killed(BaseException):
    """What no code catches."""


def test_new_vectors_take_the_place_of_old_ones_at_once(store: Store) -> None:
    info = filled(store)
    before = vectors(store, info)
    old_sql, old_index = SqlSource(store, info.id), IndexSource(index := MapIndex.open(store, info.id))
    old_sql.refresh()
    old_index.refresh()
    planned = redescribe_map(store, info, WANTED, dry_run=True)
    assert (planned.keyframes, planned.described, planned.recordings, planned.switched) == (10, 10, 0, True)
    np.testing.assert_array_equal(vectors(store, info), before)
    assert rows(store) == 10

    told: list[tuple[str, int, int]] = []
    done = redescribe_map(store, info, WANTED, progress=lambda *what: told.append(what))
    assert (done.described, done.before, done.after) == (10, MODELS[1], GIST)
    assert ("describing m", 10, 10) in told
    np.testing.assert_array_equal(vectors(store, info), expected())
    assert rows(store) == 10
    assert store.map_models(info.id) == (MODELS[0], GIST, MODELS[2])
    kinds = [change.kind for change in store.changes_since(info.id, 0)]
    assert kinds == [ChangeKind.ADDED] * 10 + [ChangeKind.REDESCRIBED] * 10

    for old in (old_sql, old_index):  # they compare with vectors of the encoder that they were opened with
        for _ in range(2):
            with pytest.raises(ProvenanceError, match="described anew by another encoder"):
                old.refresh()
    ids = np.array(store.keyframe_ids(info.id), np.int64)
    query = expected()[3]
    for source in (SqlSource(store, info.id), IndexSource(index), IndexSource(MapIndex.open(store, info.id))):
        source.refresh()
        np.testing.assert_allclose(source.cosines(query, ids), expected() @ query, atol=1e-6)
        assert source.nearest(query, 1, None, 0.0).keyframe_ids.tolist() == [ids[3]]

    again = redescribe_map(store, info, WANTED)
    assert (again.described, again.switched) == (0, False)
    assert len(store.changes_since(info.id, 0)) == 20


def test_an_index_on_disk_follows(open_file_store: Store, tmp_path: Path) -> None:
    store = open_file_store
    info = filled(store)
    MapIndex.open(store, info.id, tmp_path).close()
    redescribe_map(store, info, WANTED)
    with MapIndex.open(store, info.id, tmp_path) as index:
        assert index.state.vectors.size == 560
        query = expected()[5]
        assert index.state.nearest(query, 1, None, 0.0).keyframe_ids.tolist() == [store.keyframe_ids(info.id)[5]]


@pytest.mark.parametrize("point", ["second chunk", "before the switch", "in the switch", "after the switch"])
def test_killed_anywhere_it_goes_on(open_file_store: Store, monkeypatch: pytest.MonkeyPatch, point: str) -> None:
    killed_and_resumed(open_file_store, monkeypatch, point)


def test_killed_in_the_middle_it_goes_on_everywhere(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    killed_and_resumed(store, monkeypatch, "in the switch")


def killed_and_resumed(store: Store, monkeypatch: pytest.MonkeyPatch, point: str) -> None:
    info = filled(store)
    before, calls = vectors(store, info), [0]
    real = redescribe.add_vectors

    def second(*arguments: Any) -> None:
        calls[0] += 1
        if calls[0] == 2:
            raise Killed
        real(*arguments)

    def killed(*_: Any) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        if point == "second chunk":
            patched.setattr(redescribe, "add_vectors", second)
        elif point == "before the switch":
            patched.setattr(redescribe, "switch_encoder", killed)
        elif point == "in the switch":
            patched.setattr(encodings, "insert", killed)
            patched.setattr(redescribe, "add_vectors", lambda *arguments: _insert(real, *arguments))
        else:
            clear = redescribe.drop_vectors
            patched.setattr(redescribe, "drop_vectors", lambda *a, **k: killed() if len(a) > 3 else clear(*a, **k))
        with pytest.raises(Killed):
            redescribe_map(store, info, WANTED)
    switched = point == "after the switch"
    np.testing.assert_array_equal(vectors(store, info), expected() if switched else before)
    assert store.map_models(info.id)[1] == (GIST if switched else MODELS[1])
    assert rows(store) == (10 + 8 if point == "second chunk" else 20)
    done = redescribe_map(store, info, WANTED)
    assert done.described == (2 if point == "second chunk" else 0)
    np.testing.assert_array_equal(vectors(store, info), expected())
    assert rows(store) == 10
    assert sum(c.kind is ChangeKind.REDESCRIBED for c in store.changes_since(info.id, 0)) == 10


def _insert(real: Any, *arguments: Any) -> None:
    """`add_vectors` while `insert` is the one that kills the switch."""
    from sqlalchemy import insert as sql_insert

    kept, encodings.insert = encodings.insert, sql_insert
    try:
        real(*arguments)
    finally:
        encodings.insert = kept


def test_what_was_begun_for_another_encoder_is_dropped(open_file_store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_file_store
    info = filled(store)
    other = encodings.encoder_of(store.engine, dataclasses.replace(GIST, config='{"version":0}'), make=True)
    ids = store.keyframe_ids(info.id)
    encodings.add_vectors(
        store.engine, info.id, int(other or 0), {key: np.ones(3, np.float32) for key in [*ids[:7], 10**12]}
    )
    assert rows(store) == 17
    assert vectors(store, info).shape == (10, 128)
    redescribe_map(store, info, WANTED)
    assert rows(store) == 10
    np.testing.assert_array_equal(vectors(store, info), expected())


def test_a_keyframe_without_a_vector_gets_one(open_file_store: Store) -> None:
    """As one that was stored in the moment of a switch; mirrors hear of it."""
    store = open_file_store
    info = filled(store)
    redescribe_map(store, info, WANTED)
    key = store.keyframe_ids(info.id)[2]
    gone = tables.cnn_vectors.delete().where(tables.cnn_vectors.c.keyframe_id == key)
    retry.write(store.engine, lambda connection: connection.execute(gone))
    index = MapIndex.open(store, info.id)
    before = store.changes_since(info.id, 0)[-1].id
    done = redescribe_map(store, info, WANTED)
    assert (done.described, done.switched) == (1, False)
    told = [change.keyframe_id for change in store.changes_since(info.id, before)]
    assert told == [key]
    np.testing.assert_array_equal(vectors(store, info), expected())
    index.refresh()
    assert index.state.living == 10


def test_keyframes_that_come_meanwhile_are_described_too(
    open_file_store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_file_store
    info = filled(store)
    recording = store.find_recording(info.id, "visit")
    real, late = redescribe.switch_encoder, [frame(90)]

    def switch(*arguments: Any) -> int:
        while late:
            store.write_keyframe(recording, late.pop())
        return real(*arguments)

    monkeypatch.setattr(redescribe, "switch_encoder", switch)
    assert redescribe_map(store, info, WANTED).described == 11
    assert vectors(store, info).shape == (11, 560)


def test_who_stores_by_the_old_encoder_is_refused_after_it(open_file_store: Store) -> None:
    store = open_file_store
    info = filled(store)
    recording = store.find_recording(info.id, "visit")
    with open_store(store.engine.url.render_as_string(hide_password=False)) as other:
        redescribe_map(other, info, WANTED)
    with pytest.raises(ProvenanceError, match="is described by the encoder gist"):
        store.write_keyframe(recording, frame(90))  # this store remembers the models of before
    assert store.keyframe_count(info.id) == 10


def test_a_map_that_is_being_ingested_keeps_its_vectors(store: Store) -> None:
    info = filled(store)
    item, before = tables.ingest_items.c, vectors(store, info)

    def put(state: ItemState) -> None:
        change = update(tables.ingest_items).where(item.frame_index == 90).values(state=state.value)
        retry.write(store.engine, lambda connection: connection.execute(change))

    put(ItemState.RUNNING)
    with pytest.raises(UsageError, match="'visit' is being ingested"):
        redescribe_map(store, info, WANTED)
    np.testing.assert_array_equal(vectors(store, info), before)
    put(ItemState.PENDING)
    assert redescribe_map(store, info, WANTED).described == 0  # all of it was done


def test_an_image_that_cannot_be_read_keeps_the_map_as_it_is(open_file_store: Store) -> None:
    store = open_file_store
    info = filled(store)
    before, ids = vectors(store, info), store.keyframe_ids(info.id)
    i = tables.keyframe_images.c
    change = update(tables.keyframe_images).where(i.keyframe_id == ids[4]).values(rgb=png(4)[:60])
    retry.write(store.engine, lambda connection: connection.execute(change))
    with pytest.raises(UsageError, match=rf"1 keyframes .* keyframe_images.rgb of keyframe {ids[4]}.*semdb delete"):
        redescribe_map(store, info, WANTED)
    np.testing.assert_array_equal(vectors(store, info), before)
    store.delete_keyframes([ids[4]])
    assert redescribe_map(store, info, WANTED).described == 0
    assert vectors(store, info).shape == (9, 560)


@pytest.mark.parametrize("indexed", [False, True])
def test_a_map_that_is_deleted_is_not_called_described_anew(open_file_store: Store, indexed: bool) -> None:
    info = filled(open_file_store)
    source: Any = SqlSource(open_file_store, info.id)
    if indexed:
        source = IndexSource(MapIndex.open(open_file_store, info.id))
    source.refresh()
    open_file_store.delete_map(info.id)
    for _ in range(2):
        source.refresh()
        assert source.keyframe_count() == 0


def test_a_copy_is_of_one_encoder(open_file_store: Store, tmp_path: Path) -> None:
    info = filled(open_file_store)

    def meanwhile(done: int, total: int) -> None:
        redescribe_map(open_file_store, info, WANTED)

    with open_store(f"sqlite:///{tmp_path / 'copy.sqlite3'}", create=True) as copy:
        with pytest.raises(DatabaseError, match="'m' was described anew by another encoder while it was copied"):
            copy_map(open_file_store.engine, info.id, copy.engine, "m", progress=meanwhile)
        copied = copy_map(open_file_store.engine, info.id, copy.engine, "again")
        assert (copied.keyframes, copied.skipped) == (10, 0)


def test_an_empty_map_has_nothing_to_describe(open_file_store: Store) -> None:
    open_file_store.ensure_map("empty")
    with pytest.raises(UsageError, match="holds no keyframe"):
        redescribe_map(open_file_store, open_file_store.find_map("empty"), WANTED)


@pytest.fixture
def open_file_store(tmp_path: Path) -> Iterator[Store]:
    """On SQLite alone."""
    with open_store(f"sqlite:///{tmp_path / 'a.sqlite3'}", create=True) as opened:
        yield opened


def run(url: str, *arguments: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["ingest", *arguments, "--database-url", url])
    return done.exit_code, done.stdout, done.stderr


def test_images_that_were_not_kept_come_from_the_recording(
    room: Path, networks: dict[str, str], tmp_path: Path
) -> None:
    """The command, on a map of grey images: nothing is written while the recording is away."""
    url, there = f"sqlite:///{tmp_path / 'a.sqlite3'}", tmp_path / "there"
    shutil.copytree(room, there)
    settings = Settings(database_url=url, detector="recorded", encoder=networks["encoder"], keep_images="none",
                        features="orb", max_keypoints=100)  # fmt: skip
    with semdb.Database(settings) as db:
        db.ingest(there, map="m", keyframes=3)
        kept = db.export
        assert kept is not None
    code, out, err = run(url, "--redescribe", "encoder", "--map", "m", "--encoder", "gist", "--dry-run")
    assert (code, out.split(":")[0], "3 of them from recordings" in out) == (0, "m", True), err
    there.rename(tmp_path / "away")
    with open_store(url) as store:
        before = vectors(store, store.find_map("m"))
    code, out, err = run(url, "--redescribe", "encoder", "--map", "m", "--encoder", "gist")
    assert (code, out) == (1, "")
    assert "no such folder or file on this machine; mount it where it was; only small grey images" in err
    with open_store(url) as store:
        np.testing.assert_array_equal(vectors(store, store.find_map("m")), before)
        assert rows(store) == 3
    (tmp_path / "away").rename(there)
    code, out, err = run(url, "--redescribe", "encoder", "--encoder", "gist", "--json")
    assert code == 0, err
    [done] = json.loads(out)
    assert (done["map"], done["described"], done["recordings"], done["switched"]) == ("m", 3, 3, True)
    with semdb.Database(settings.model_copy(update={"encoder": "gist"})) as db:
        assert db.localize(sorted((there / "rgb").iterdir())[0], like=str(there)).world_from_camera is not None


def test_a_map_that_is_being_ingested_keeps_no_other_from_it(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with open_store(url, create=True) as store:
        for name in ("busy", "free"):
            planned = store.plan_recording(store.ensure_map(name), plan("visit", [0, 90]), MODELS)
            store.write_keyframe(planned.recording_id, frame(0))
        i = tables.ingest_items
        running = update(i).where(i.c.recording_id == 1, i.c.frame_index == 90).values(state=ItemState.RUNNING.value)
        retry.write(store.engine, lambda connection: connection.execute(running))
    code, out, err = run(url, "--redescribe", "encoder", "--encoder", "gist", "--json")
    assert code == 2
    assert "busy: not described anew: the recording 'visit' is being ingested" in err
    [done] = json.loads(out)
    assert (done["map"], done["switched"]) == ("free", True)


def test_what_makes_no_sense_is_said(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    for arguments, wanted in (
        (("--redescribe", "features"), "what can be described anew is the encoder's vectors: encoder"),
        (("--redescribe", "encoder", "room", "--stride", "3"), "takes no PATH, --stride"),
        (("--redescribe", "encoder", "--resume"), "takes no --resume"),
        (("--dry-run", "room"), "--dry-run is for --redescribe"),
    ):
        code, out, err = run(url, *arguments)
        assert (code, out) == (2, "")
        assert wanted in err


def test_recordings_errors_are_of_semdb() -> None:
    assert issubclass(RecordingError, semdb.SemdbError)


@pytest.mark.long
def test_a_killed_process_leaves_a_map_that_answers(store: Store) -> None:
    """Killed as soon as some new vectors are there; the next run does the others only."""
    frames = range(80)
    planned = store.plan_recording(store.ensure_map("m"), plan("visit", [*frames]), MODELS)
    for index in frames:
        store.write_keyframe(planned.recording_id, frame(index))
    info = store.find_map("m")
    old, url = vectors(store, info), store.engine.url.render_as_string(hide_password=False)
    command = [
        sys.executable,
        "-m",
        "semdb.cli.main",
        "ingest",
        "--redescribe",
        "encoder",
        "--encoder",
        "gist",
        "--json",
    ]
    process = subprocess.Popen([*command, "--database-url", url], stdout=subprocess.PIPE)
    try:
        while rows(store) == len(frames) and process.poll() is None:
            time.sleep(0.005)
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate()
    written = rows(store) - len(frames)
    assert 0 < written < len(frames)
    np.testing.assert_array_equal(vectors(store, info), old)
    done = subprocess.run([*command, "--database-url", url], stdout=subprocess.PIPE, check=True, text=True)
    assert json.loads(done.stdout)[0]["described"] == len(frames) - written
    np.testing.assert_array_equal(vectors(store, info), np.stack([GistEncoder().encode(image(i)) for i in frames]))
    assert rows(store) == len(frames)
