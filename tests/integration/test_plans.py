"""Other keyframes than planned: a plan grows, nothing is taken away, and what differs is said as it is."""

from __future__ import annotations

import json
import re
import shutil
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.store import Store, open_store
from semdb.errors import UsageError
from semdb.ingestion.keyframes import select_keyframes
from semdb.ingestion.queue import Workplace, queue_recordings
from semdb.ingestion.run import IngestOptions, IngestSummary, ingest_recordings
from semdb.recordings import open_recording
from semdb.settings import Settings
from tests.integration.comparison import content
from tests.integration.test_faults import make_schema
from tests.integration.test_queue import Outbox

FEW, MORE = 4, 7


def settings(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", features="orb", max_keypoints=100, threads=1)


def ingest(folder: Path, url: str, **options: Any) -> IngestSummary:
    [summary] = ingest_recordings([folder], settings(url), IngestOptions(map_name="m", check=False, **options))
    return summary


def frames_of(store: Store) -> list[int]:
    return sorted(head.frame_index for head in store.keyframe_heads(store.find_map("m").id))


def densified(room: Path, start: Sequence[int], count: int) -> list[int]:
    """As the docs have it, one by one: the frame whose greatest common view with those there is least."""
    recording = open_recording(room)
    keep = [entry for entry in recording.entries if entry.index in start]
    return [entry.index for entry in select_keyframes(recording, count=count, keep=keep)]


def test_more_keyframes_are_added_to_those_that_are_there(room: Path, database_url: str) -> None:
    first = ingest(room, database_url, stride=8)
    assert (first.planned, first.stored) == (3, 3)
    with open_store(database_url) as store:
        [before] = store.status()
        ids = {head.frame_index: head.id for head in store.keyframe_heads(before.map_id)}
        assert sorted(ids) == [0, 8, 16]
    more = ingest(room, database_url, keyframes=MORE)
    assert (more.planned, more.already_stored, more.stored, more.failed) == (MORE, 3, MORE - 3, {})
    with open_store(database_url) as store:
        there = frames_of(store)
        assert there == densified(room, [0, 8, 16], MORE)
        assert {0, 8, 16} < set(there)
        now = {head.frame_index: head.id for head in store.keyframe_heads(before.map_id)}
        assert {frame: now[frame] for frame in ids} == ids  # what is there is not written again
        [status] = store.status()
        assert (status.state, status.keyframes, dict(status.items)) == ("complete", MORE, {"done": MORE})
    for options in ({}, {"keyframes": MORE}):  # it is the plan now
        again = ingest(room, database_url, **options)
        assert (again.planned, again.already_stored, again.stored) == (MORE, MORE, 0)


def test_a_densified_map_is_one_that_was_planned_so(room: Path, tmp_path: Path) -> None:
    """Each next keyframe is chosen after those before it, so in one step or in two is the same."""
    urls = [f"sqlite:///{tmp_path / name}.sqlite3" for name in ("two", "one")]
    ingest(room, urls[0], keyframes=FEW)
    ingest(room, urls[0], keyframes=MORE)
    ingest(room, urls[1], keyframes=MORE)
    with open_store(urls[0]) as two, open_store(urls[1]) as one:
        assert content(two) == content(one)


def test_a_plan_that_failed_or_lacks_deleted_keyframes_grows(room: Path, tmp_path: Path) -> None:
    copy, url = tmp_path / "room", f"sqlite:///{tmp_path / 'a.sqlite3'}"
    shutil.copytree(room, copy)
    colour = sorted((copy / "rgb").iterdir())[8]
    whole = colour.read_bytes()
    colour.write_bytes(whole[: len(whole) // 2] + b"rubbish" * 9 + whole[len(whole) // 2 + 63 :])
    assert list(ingest(copy, url, stride=8).failed) == [8]
    with open_store(url) as store:
        head = store.keyframe_heads(store.find_map("m").id)[0]
        store.delete_keyframes([head.id])
        assert frames_of(store) == [16]
    colour.write_bytes(whole)
    more = ingest(copy, url, keyframes=5)
    assert (more.planned, more.stored, more.failed) == (5, 3, {})
    with open_store(url) as store:
        assert set(frames_of(store)) == set(densified(room, [0, 8, 16], 5)) - {0}


def test_two_processes_densify_at_once(room: Path, any_server_url: str) -> None:
    make_schema(any_server_url)
    ingest(room, any_server_url, keyframes=2)
    results: list[IngestSummary] = []
    threads = [
        threading.Thread(target=lambda: results.append(ingest(room, any_server_url, keyframes=6))) for _ in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sum(summary.stored for summary in results) == 4
    with open_store(any_server_url) as store:
        assert len(frames_of(store)) == 6


@pytest.fixture(scope="module")
def planned(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database that nothing changes."""
    file = tmp_path_factory.mktemp("planned") / "a.sqlite3"
    ingest(room, f"sqlite:///{file}", keyframes=FEW)
    return file


def refused_of(other: Path, planned: Path, options: dict[str, int]) -> str:
    with pytest.raises(UsageError) as caught:
        ingest(other, f"sqlite:///{planned}", **options)
    return str(caught.value)


def edited(room: Path, copy: Path, name: str, change: Any) -> Path:
    shutil.copytree(room, copy)
    (copy / name).write_text(change((copy / name).read_text()))
    return copy


def camera_of(**values: float) -> Any:
    return lambda text: json.dumps({**json.loads(text), **values})


def test_keyframes_that_would_be_taken_away(room: Path, planned: Path) -> None:
    name = f"^the recording {room.name!r} of the map 'm' was planned with 4 keyframes, "
    with pytest.raises(UsageError, match=f"{name}and 3 are asked for: more are added, none is taken away"):
        ingest(room, f"sqlite:///{planned}", keyframes=3)
    with pytest.raises(UsageError, match=rf"{name}of which --stride 5 leaves out [123] \(frames? [\d, ]+\)"):
        ingest(room, f"sqlite:///{planned}", stride=5)
    with pytest.raises(UsageError, match="not both"):
        ingest(room, f"sqlite:///{planned}", stride=1, keyframes=9)


@pytest.mark.parametrize("options", [{}, {"keyframes": FEW}, {"keyframes": MORE}, {"stride": 1}])
@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("camera.json", camera_of(fx=301.5), r"its camera was 320x240 [\d.,]+, and is 320x240 301.5,[\d.,]+ now"),
        ("camera.json", camera_of(depth_scale=1000), "its depth scale was 5000, and is 1000 now"),
        (
            "groundtruth.txt",
            lambda text: re.sub(r"^([\d.]+) (\S+)", lambda m: f"{m[1]} {float(m[2]) + 1}", text, flags=re.MULTILINE),
            "poses of its keyframes, or names of their files, are others now",
        ),
        ("rgb.txt", lambda text: "".join(text.splitlines(keepends=True)[:12]), r"its number of frames is 24, not \d+"),
    ],
)
def test_what_is_different_is_said(
    room: Path, planned: Path, tmp_path: Path, file: str, change: Any, said: str, options: dict[str, int]
) -> None:
    other = edited(room, tmp_path / room.name, file, change)
    problem = refused_of(other, planned, options)
    assert re.search(said, problem), problem
    assert "is stored already and is another one: " in problem


def test_a_planned_frame_that_cannot_be_used_is_named(room: Path, planned: Path, tmp_path: Path) -> None:
    other = shutil.copytree(room, tmp_path / room.name)
    sorted((other / "rgb").iterdir())[0].write_bytes(b"")
    problem = refused_of(other, planned, {"keyframes": MORE})
    assert "frame 0, which it was planned with, cannot be used (`semdb recording` says why)" in problem


def test_an_ingest_that_stores_nothing_says_nothing_of_objects(room: Path, tmp_path: Path) -> None:
    command = ["ingest", str(room), "--map", "m", "--no-check", "--features", "orb", "--encoder", "gist"]
    command += ["--detector", "recorded", "--database-url", f"sqlite:///{tmp_path / 'a.sqlite3'}", "--keyframes"]

    def lines(count: int) -> dict[str, str]:
        result = CliRunner().invoke(app, [*command, str(count)])
        assert result.exit_code == 0, result.output
        return {line.split()[0]: line for line in result.stdout.splitlines()}

    first, again, more = lines(2), lines(2), lines(3)
    assert re.fullmatch(r"objects    \d+, and \d+ keypoints, in 2 keyframes stored now", first["objects"])
    assert "objects" not in again
    assert again["keyframes"] == "keyframes  2 planned, 0 stored now, 2 stored before, 0 failed"
    assert re.fullmatch(r"objects    \d+, and \d+ keypoints, in the keyframe stored now", more["objects"])
    assert more["keyframes"] == "keyframes  3 planned, 1 stored now, 2 stored before, 0 failed"


def test_workers_get_what_was_added(room: Path, tmp_path: Path) -> None:
    url, outbox = f"sqlite:///{tmp_path / 'a.sqlite3'}", Outbox()
    place = Workplace(settings(url))
    for count, sent in ((3, 3), (5, 2), (5, 0)):
        before = len(outbox)
        queue_recordings([str(room)], settings(url), IngestOptions(map_name="m", keyframes=count), outbox.send)
        frames = [frame for _, _, chunk in outbox[before:] for frame in chunk]
        assert len(frames) == sent
        for recording_id, source, chunk in outbox[before:]:
            outcome = place.do(recording_id, source, chunk)
            assert (outcome.stored, outcome.failed, outcome.complete) == (sent, {}, True)
    with open_store(url) as store:
        assert frames_of(store) == densified(room, [0], 5)
