"""Ingest on both servers: the rows, running again, cut off and run again, broken frames."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import select

from semdb.database import tables
from semdb.database.store import Store, open_store
from semdb.errors import ProvenanceError, UsageError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.settings import Settings
from tests.integration.comparison import NOT_COMPARED, content, rows_per_table
from tests.rooms import COMMAND, environment, semdb

KEYFRAMES = 8


def settings(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", features="surf", threads=1)


def dump(store: Store) -> dict[str, list[tuple[Any, ...]]]:
    """All rows of all tables but times, sorted; blobs whole."""
    found = {}
    with store.engine.connect() as connection:
        for table in tables.metadata.sorted_tables:
            columns = [column for column in table.columns if column.name not in NOT_COMPARED]
            found[table.name] = sorted(map(tuple, connection.execute(select(*columns))), key=repr)
    return found


def test_ingest_stores_what_it_says_and_again_adds_nothing(room: Path, database_url: str) -> None:
    [summary] = ingest_recordings([room], settings(database_url), IngestOptions(keyframes=KEYFRAMES))
    assert (summary.total_frames, summary.usable_frames, summary.planned, summary.stored) == (
        24,
        24,
        KEYFRAMES,
        KEYFRAMES,
    )
    assert summary.failed == {}
    with open_store(database_url) as store:
        before = dump(store)
        rows = rows_per_table(store)
        assert rows["keyframes"] == rows["keyframe_images"] == rows["cnn_vectors"] == rows["keypoints"] == KEYFRAMES
        assert rows["objects"] == summary.objects > 2 * KEYFRAMES
        assert summary.keypoints > 100 * KEYFRAMES
        [status] = store.status()
        assert (status.state, status.keypoints) == ("complete", summary.keypoints)
    [again] = ingest_recordings([room], settings(database_url), IngestOptions(keyframes=KEYFRAMES))
    [resumed] = ingest_recordings([room], settings(database_url))
    assert (again.stored, again.already_stored) == (0, KEYFRAMES)
    assert (resumed.stored, resumed.planned) == (0, KEYFRAMES)
    with open_store(database_url) as store:
        assert dump(store) == before


def test_both_servers_hold_equal_rows(room: Path, tmp_path: Path, server_url: str) -> None:
    from semdb.database import schema
    from semdb.database.engine import make_engine

    urls = [f"sqlite:///{tmp_path / 'one.sqlite3'}", server_url]
    dumps = []
    for url in urls:
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        ingest_recordings([room], settings(url), IngestOptions(keyframes=KEYFRAMES))
        with open_store(url) as store:
            dumps.append(dump(store))
    assert dumps[0].keys() == dumps[1].keys()
    for name, rows in dumps[0].items():
        assert rows == dumps[1][name], name


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGINT, 130)])
def test_cut_off_and_run_again_ends_with_the_same_rows(
    room: Path, database_url: str, tmp_path: Path, sent: signal.Signals, code: int
) -> None:
    undisturbed = f"sqlite:///{tmp_path / 'undisturbed.sqlite3'}"
    ingest_recordings([room], settings(undisturbed), IngestOptions(keyframes=KEYFRAMES))
    command = [*COMMAND, "ingest", str(room), "--keyframes", str(KEYFRAMES)]
    specs = {"SEMDB_DETECTOR": "recorded", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "surf"}
    interrupted = 0
    for wanted in (2, 5):
        process = subprocess.Popen(
            command, env=environment(database_url, **specs), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        if wait_for_keyframes(database_url, wanted, process):
            os.kill(process.pid, sent)
            interrupted += int(process.wait(60) == code)
        else:
            process.wait(60)
    assert interrupted >= 1, "the ingest was never cut off: the test tests nothing"
    [summary] = ingest_recordings([room], settings(database_url), IngestOptions(keyframes=KEYFRAMES))
    assert summary.already_stored + summary.stored == KEYFRAMES
    with open_store(undisturbed) as expected, open_store(database_url) as store:
        assert content(store) == content(expected)


def wait_for_keyframes(url: str, count: int, process: subprocess.Popen[bytes]) -> bool:
    """Whether the process still ran when `count` keyframes were stored."""
    with open_store(url) as store:
        while process.poll() is None:
            if rows_per_table(store)["keyframes"] >= count:
                return process.poll() is None
            time.sleep(0.005)
    return False


def test_a_broken_keyframe_fails_and_the_rest_goes_on(room: Path, tmp_path: Path) -> None:
    copy = tmp_path / "broken"
    shutil.copytree(room, copy)
    url = f"sqlite:///{tmp_path / 'broken.sqlite3'}"
    first = sorted((copy / "rgb").iterdir())[8]
    data = bytearray(first.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 400] = bytes(400)  # header and end are whole: only decoding can tell
    first.write_bytes(data)
    [summary] = ingest_recordings([copy], settings(url), IngestOptions(stride=4))
    assert list(summary.failed) == [8]
    assert first.name in summary.failed[8]
    assert summary.stored == 5
    with open_store(url) as store:
        [item] = store.failed_items()
        assert (item.frame_index, first.name in item.error) == (8, True)
    first.write_bytes((room / "rgb" / first.name).read_bytes())
    [again] = ingest_recordings([copy], settings(url), IngestOptions(stride=4))
    assert (again.stored, again.already_stored, again.failed) == (1, 5, {})


def test_frames_add_up_and_the_source_is_absolute(room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy = tmp_path / "broken"
    shutil.copytree(room, copy)
    depth = sorted((copy / "depth").iterdir())
    for number, position in ((8, -2000), (9, -3)):  # damaged in the middle, and cut off
        data = bytearray(depth[number].read_bytes())
        data[position] ^= 0xFF
        depth[number].write_bytes(data if number == 8 else data[:position])
    url = f"sqlite:///{tmp_path / 'broken.sqlite3'}"
    monkeypatch.chdir(tmp_path)
    [summary] = ingest_recordings([Path("broken")], settings(url), IngestOptions(keyframes=3))
    assert (summary.total_frames, summary.usable_frames, len(summary.dropped)) == (24, 22, 2)
    with open_store(url) as store:
        assert store.status()[0].source == str(copy)


def test_other_models_and_other_plans_are_refused(room: Path, tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'one.sqlite3'}"
    ingest_recordings([room], settings(url), IngestOptions(keyframes=3, map_name="m"))
    with pytest.raises(ProvenanceError, match=r"surf.*sift|sift.*surf"):
        ingest_recordings([room], settings(url).model_copy(update={"features": "sift"}), IngestOptions(map_name="m"))
    with pytest.raises(UsageError, match="semdb delete"):
        ingest_recordings([room], settings(url), IngestOptions(keyframes=2, map_name="m"))
    with open_store(url) as store:
        assert rows_per_table(store)["keyframes"] == 3


def test_the_command_that_retry_prints_goes_on_with_the_recording(room: Path, tmp_path: Path) -> None:
    """A folder with a space in its name, in a map and under a name of somebody's choice, with a camera by hand."""
    copy = tmp_path / "my room"
    shutil.copytree(room, copy)
    broken = sorted((copy / "depth").glob("*.png"))[0]
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2] + b"\xff" + whole[len(whole) // 2 + 1 :])
    where = {"url": f"sqlite:///{tmp_path / 'a.sqlite3'}", "SEMDB_ENCODER": "gist", "SEMDB_FEATURES": "orb"}
    camera = json.loads((copy / "camera.json").read_text())
    numbers = ",".join(str(camera[name]) for name in ("fx", "fy", "cx", "cy"))
    chosen = ("--map", "the house", "--name", "visit", "--camera", numbers)
    first = semdb("ingest", copy, "--stride", 8, *chosen, **where)  # type: ignore[arg-type]
    assert first.returncode == 1, first.stderr
    broken.write_bytes(whole)
    printed = semdb("retry", **where).stdout.splitlines()  # type: ignore[arg-type]
    assert printed[0].startswith("the house/visit: 1 put back; run: semdb ingest ")
    words = shlex.split(printed[0].partition("run: semdb ")[2])
    again = semdb(*words, "--json", **where)  # type: ignore[arg-type]
    assert again.returncode == 0, again.stderr
    [summary] = json.loads(again.stdout)
    assert (summary["map"], summary["recording"], summary["keyframes"]) == ("the house", "visit", 3)
    assert (summary["stored"], summary["already_stored"]) == (1, 2)
    with open_store(where["url"]) as store:
        assert [recording.items for recording in store.status()] == [{"done": 3}]
        assert len(store.maps()) == 1
