"""`semdb compact`: rows rewritten smaller, each keyframe wholly or not at all, and answers that stay."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from sqlalchemy import event, func, select, update
from typer.testing import CliRunner

import semdb
from semdb.cli.main import app
from semdb.database import tables
from semdb.database.compacting import Compacted, compact_map
from semdb.database.store import Store, open_store
from semdb.errors import CodecError, UsageError
from semdb.geometry import pose_error
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.localization.index import MapIndex
from semdb.settings import Settings


def run(url: str, *arguments: str) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["compact", "--map", "m", *arguments, "--database-url", url])
    return done.exit_code, done.stdout, done.stderr


KEYFRAMES = 5


def made(room: Path, url: str) -> None:
    settings = Settings(
        database_url=url, detector="recorded", encoder="gist", features="surf", max_keypoints=300, threads=1,
        descriptor_dtype="float32",
    )  # fmt: skip
    ingest_recordings([room], settings, IngestOptions(keyframes=KEYFRAMES, map_name="m"))


@pytest.fixture(scope="module")
def ready(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("compact") / "ready.sqlite3"
    made(room, f"sqlite:///{file}")
    return file


@pytest.fixture
def url(ready: Path, tmp_path: Path) -> str:
    """A map of its own."""
    return f"sqlite:///{shutil.copy(ready, tmp_path / 'a.sqlite3')}"


def kinds(store: Store) -> list[str]:
    return [k.keypoints.features.descriptors.dtype.name for k in store.load_keyframes(store.keyframe_ids(1))]


def sizes(store: Store) -> tuple[int, int]:
    """Bytes of descriptors and keypoints, and of image files as the columns of their sizes say."""
    d, k, i = tables.descriptors.c, tables.keypoints.c, tables.keyframe_images.c
    with store.engine.connect() as connection:
        rows = sum(int(connection.execute(select(func.sum(func.length(c.data)))).scalar_one()) for c in (d, k))
        images = connection.execute(select(func.sum(i.rgb_bytes + i.depth_bytes))).scalar_one()
    return rows, int(images)


def test_a_map_is_rewritten_and_answers_as_before(room: Path, database_url: str, tmp_path: Path) -> None:
    made(room, database_url)
    with semdb.open(database_url) as db:
        db.refine("m")
        before = {a.frame_index: a for a in db.localize_recording(room, every=12)}
        with open_store(database_url) as store, MapIndex.open(store, 1, tmp_path / "index"):
            rows, images = sizes(store)
            planned = db.compact("m", dry_run=True)
            assert (planned.rows_before, planned.images_before) == (rows, images)
            assert sizes(store) == (rows, images)
            done = db.compact("m")
            assert done == planned
            assert done.rewritten == KEYFRAMES
            assert sizes(store) == (done.rows_after, images)
            assert done.rows_after < 0.31 * done.rows_before
            assert kinds(store) == ["int8"] * KEYFRAMES
            assert db.compact("m") == Compacted(KEYFRAMES, 0, done.rows_after, done.rows_after, images, images)
        said: list[str] = []
        with open_store(database_url) as store, MapIndex.open(store, 1, tmp_path / "index", say=said.append) as index:
            assert said == []  # its files are those of the map still
            assert len(index.state.ids) == KEYFRAMES
        assert all(one.current for one in open_store(database_url).refinements(1))
    with semdb.open(database_url) as db:
        for found in db.localize_recording(room, every=12):
            metres, degrees = pose_error(found.world_from_camera, before[found.frame_index].world_from_camera)
            assert (found.verdict, metres < 0.005, degrees < 0.1) == ("localized", True, True)


def test_images_become_small_and_localize_still(room: Path, url: str) -> None:
    with semdb.open(url) as db, open_store(url) as store:
        _, images = sizes(store)
        jpeg = db.compact("m", dtype=None, keep_images="jpeg")
        assert sizes(store)[1] == jpeg.images_after < 0.9 * images
        assert store.load_image(1).depth is not None
        assert kinds(store) == ["float32"] * KEYFRAMES
        none = db.compact("m", dtype=None, keep_images="none")
        assert sizes(store)[1] == none.images_after < 0.06 * images
        files = store.load_image(1)
        assert (files.rgb_format, files.depth, files.depth_format, files.depth_scale) == ("jpeg", None, "", None)
        assert db.compact("m", dtype=None, keep_images="none").rewritten == 0
        assert {found.verdict for found in db.localize_recording(room, every=12)} == {"localized"}


def test_stopped_anywhere_each_keyframe_is_old_or_new(url: str) -> None:
    for stop in range(4):  # after the first UPDATE of the third keyframe that is left, and so on
        with open_store(url) as store:
            left, count = stop + 1, [0]

            def fail(*arguments: object, limit: int = left, seen: list[int] = count) -> None:
                if str(arguments[2]).startswith("UPDATE"):
                    seen[0] += 1
                    if seen[0] > limit:
                        raise KeyboardInterrupt

            event.listen(store.engine, "before_cursor_execute", fail)
            with pytest.raises(KeyboardInterrupt):
                compact_map(store.engine, 1, "uint8", None)
        with open_store(url) as store:
            for kept in store.load_keyframes(store.keyframe_ids(1)):
                k, d = tables.keypoints.c, tables.descriptors.c
                with store.engine.connect() as connection:
                    heads = [
                        bytes(connection.execute(select(c.data).where(c.keyframe_id == kept.id)).scalar_one())[:4]
                        for c in (k, d)
                    ]
                assert heads in ([b"SDBA", b"SDBA"], [b"SDBK", b"SDBQ"])
    with open_store(url) as store:
        compact_map(store.engine, 1, "uint8", None)
        assert kinds(store) == ["int8"] * KEYFRAMES


def test_what_is_damaged_stays_and_is_told(url: str) -> None:
    with open_store(url) as store:
        with store.engine.begin() as connection:
            connection.execute(
                update(tables.descriptors).where(tables.descriptors.c.keyframe_id == 2).values(data=b"x")
            )
        with pytest.raises(CodecError, match=r"descriptors.data of keyframe 2"):
            compact_map(store.engine, 1, "uint8", None)
        told: list[int] = []
        done = compact_map(store.engine, 1, "uint8", None, bad=lambda key, error: told.append(key))
        assert (told, done.rewritten) == ([2], KEYFRAMES - 2)  # the first was done before


def test_an_image_that_cannot_be_read_stays_and_is_told(url: str) -> None:
    with open_store(url) as store, store.engine.begin() as connection:
        of_two = tables.keyframe_images.c.keyframe_id == 2
        connection.execute(update(tables.keyframe_images).where(of_two).values(rgb=b"\x89PNG\r\n\x1a\n"))
    code, out, err = run(url, "--images", "jpeg", "--yes")
    assert code == 0
    assert f"{KEYFRAMES - 1} of {KEYFRAMES - 1} keyframes rewritten" in out
    assert "keyframe 2" in err


def test_the_command_says_what_is_saved(url: str) -> None:
    code, out, _ = run(url, "--dry-run")
    assert code == 0
    assert f"{KEYFRAMES} of {KEYFRAMES} keyframes would be rewritten" in out
    code, _, err = run(url, "--images", "none")
    assert code == 2
    assert "give --yes" in err
    assert run(url, "--descriptors", "uint4")[0] == 2
    with semdb.open(url) as db, pytest.raises(UsageError, match="original, jpeg, none"):
        db.compact("m", keep_images="png")
    assert run(url, "--images", "jpeg", "--yes")[0] == 0
