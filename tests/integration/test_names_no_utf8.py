r"""Folders and images whose names are no UTF-8, and terminals that are not: nothing is lost, and names come back."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from semdb.api import Database
from semdb.cli.status import ingest_again
from semdb.database.store import open_store
from semdb.errors import NotFoundError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.recordings import open_recordings
from semdb.recordings.source import parse_source
from semdb.settings import Settings
from tests.rooms import COMMAND, environment

CAFE = os.fsdecode(b"caf\xe9")


@pytest.fixture(scope="module")
def cafe(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room in a folder, and with images, whose names have a byte of Latin-1."""
    folder = tmp_path_factory.mktemp("names") / CAFE
    shutil.copytree(room, folder)
    for number, image in enumerate(sorted((folder / "rgb").iterdir())):
        name = os.fsdecode(b"bild\xfc%03d.png" % number)
        (folder / "masks" / image.name).rename(folder / "masks" / name)
        image.rename(folder / "rgb" / name)
    images = sorted((folder / "rgb").iterdir())
    lines = [line.split()[0] for line in (folder / "rgb.txt").read_text().splitlines() if line[0] != "#"]
    text = "".join(f"{time} rgb/{image.name}\n" for time, image in zip(lines, images, strict=True))
    (folder / "rgb.txt").write_bytes(os.fsencode(text))
    return folder


def settings_of(url: str) -> Settings:
    return Settings(database_url=url, detector="recorded", encoder="gist", features="surf", threads=1)


def test_they_are_ingested_localized_and_logged_on_every_server(cafe: Path, database_url: str) -> None:
    empty_url = database_url
    [summary] = ingest_recordings([cafe], settings_of(empty_url), IngestOptions(stride=6))
    assert (summary.recording, summary.map_name) == (r"caf\udce9", r"caf\udce9")
    assert (summary.stored, summary.failed) == (4, {})
    [again] = ingest_recordings([cafe], settings_of(empty_url), IngestOptions(stride=6))
    assert (again.stored, again.already_stored) == (0, 4)
    with open_store(empty_url) as store:
        [status] = store.status()
        assert (status.name, status.map) == (r"caf\udce9", r"caf\udce9")
        assert os.fsencode(parse_source(status.source).address) == os.fsencode(cafe)
        assert "$'" in ingest_again(status)
        assert r"caf\xe9" in ingest_again(status)
        assert store.find_map(CAFE).name == r"caf\udce9"  # as the shell gives it
    said: list[str] = []
    image = cafe / "rgb" / os.fsdecode(b"bild\xfc004.png")
    with Database(settings_of(empty_url), say=said.append) as database:
        answer = database.localize(image, map=CAFE)
        assert str(answer.verdict) == "localized"
        assert os.fsencode(answer.image) == os.fsencode(image)
        with pytest.raises(NotFoundError):
            database.localize(image, map="none")
    assert not [line for line in said if "log of queries" in line]
    with open_store(empty_url) as store:
        from sqlalchemy import text

        with store.engine.connect() as connection:
            [[logged]] = connection.execute(text("SELECT image FROM queries"))
    assert logged.endswith(r"rgb/bild\udcfc004.png")


def test_a_recording_of_them_keeps_its_paths_and_has_names_for_people(cafe: Path) -> None:
    [recording] = open_recordings(cafe)
    assert recording.name == r"caf\udce9"
    assert recording.entries[3].name == r"rgb/bild\udcfc003.png"
    assert recording.read(recording.entries[3]).instances is not None


def command(*arguments: str, url: str, encoding: str | None = None, **more: str) -> subprocess.CompletedProcess[bytes]:
    variables = environment(url, **more) | ({} if encoding is None else {"PYTHONIOENCODING": encoding})
    return subprocess.run([*COMMAND, *arguments], env=variables, capture_output=True, timeout=300, check=False)


@pytest.fixture(scope="module")
def url(cafe: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    made = f"sqlite:///{tmp_path_factory.mktemp('database') / 'semdb.sqlite3'}"
    ingest_recordings([cafe], settings_of(made), IngestOptions(stride=6, map_name="Küche 厨房"))
    return made


def test_commands_answer_for_images_and_go_on_after_broken_ones(cafe: Path, url: str, tmp_path: Path) -> None:
    images = [cafe / "rgb" / os.fsdecode(b"bild\xfc%03d.png" % number) for number in (1, 7)]
    none = os.fsdecode(b"none\xe9.png")
    done = command("localize", str(images[0]), none, str(images[1]), "--json", "--plot", str(tmp_path), url=url)
    assert done.returncode == 1  # one is not there
    assert b"Traceback" not in done.stderr
    assert rb"none\udce9.png: no such file" in done.stderr
    answers = json.loads(done.stdout.decode("utf-8"))
    assert [os.fsencode(answer["image"]) for answer in answers] == [os.fsencode(image) for image in images]
    assert [answer["verdict"] for answer in answers] == ["localized", "localized"]
    assert len(list(tmp_path.glob("*.png"))) == 2
    like = command("localize", str(images[0]), "--like", str(cafe), url=url)
    assert (like.returncode, b"Traceback" in like.stderr) == (0, False)


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
@pytest.mark.parametrize("arguments", [["status"], ["sql", "SELECT name FROM maps"], ["--help"], ["recording", "CAFE"]])
def test_no_terminal_costs_an_answer(cafe: Path, url: str, encoding: str, arguments: list[str]) -> None:
    given = [str(cafe) if word == "CAFE" else word for word in arguments]
    done = command(*given, url=url, encoding=encoding)
    assert done.returncode == 0, done.stderr
    assert done.stderr == b"" or b"Traceback" not in done.stderr
    text = done.stdout.decode(encoding)
    if arguments[0] in ("status", "sql"):
        shown = {"utf-8": "Küche 厨房", "latin-1": r"Küche \u53a8\u623f", "ascii": r"K\xfcche \u53a8\u623f"}
        assert shown[encoding] in text


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "utf-8"])
def test_json_is_json_on_every_terminal(url: str, encoding: str) -> None:
    for arguments in (["status", "--json"], ["sql", "SELECT name FROM maps", "--format", "json"]):
        done = command(*arguments, url=url, encoding=encoding)
        assert done.returncode == 0, done.stderr
        [row] = json.loads(done.stdout.decode(encoding))
        assert row.get("map", row.get("name")) == "Küche 厨房"


def test_an_answer_that_cannot_be_logged_is_given(cafe: Path, url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from semdb.database import reporting

    def refuses(*_: object) -> int:
        raise UnicodeEncodeError("utf-8", "\udce9", 0, 1, "surrogates not allowed")

    monkeypatch.setattr(reporting, "log_query", refuses)
    said: list[str] = []
    with Database(settings_of(url), say=said.append) as database:
        answer = database.localize(cafe / "rgb" / os.fsdecode(b"bild\xfc004.png"))
    assert str(answer.verdict) == "localized"
    assert any("is not in the log of queries" in line for line in said)
