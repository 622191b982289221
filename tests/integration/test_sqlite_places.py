"""SQLite files where nothing can be written, which others use, delete or replace, and paths that name no database."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.engine import make_engine, parse_url
from semdb.database.schema import current_revision
from semdb.database.sqlite_file import Opening, how_it_is_read, opening_of
from semdb.database.store import open_store
from semdb.errors import DatabaseError, SchemaError, UsageError
from tests.database_samples import fill
from tests.other_user import NOBODY, as_somebody_else, give

OTHER = 65533


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that every account can look into, which one below pytest's own is not."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        os.chmod(name, 0o755)
        yield Path(name)
        os.chmod(name, 0o755)


@pytest.fixture
def file(folder: Path) -> Path:
    """A database at rest."""
    path = folder / "maps.sqlite3"
    with open_store(f"sqlite:///{path}", create=True) as store:
        fill(store)
    assert names(folder) == ["maps.sqlite3"]
    return path


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def semdb(*arguments: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command in this process."""
    done = CliRunner().invoke(app, list(arguments))
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.exit_code, done.stdout, done.stderr


def where_nothing_can_be_written(function: Callable[[], Any], folder: Path) -> Any:
    """`function` where the rights of `folder` forbid writing, which they do not forbid root."""
    function()  # all imports happen here
    os.chmod(folder, 0o555)
    return as_somebody_else(function) if os.geteuid() == 0 else function()


@pytest.mark.parametrize("link", [False, True])
def test_a_file_that_cannot_be_written_is_read(folder: Path, file: Path, link: bool) -> None:
    os.chmod(file, 0o444)
    path = file
    if link:
        path = folder / "link.sqlite3"
        path.symlink_to(file)
    url = f"sqlite:///{path}"

    def look() -> Any:
        status = semdb("status", "--database-url", url)
        keypoints = semdb("keypoints", "1", "--csv", "--database-url", url)
        return status, keypoints, semdb("retry", "--database-url", url)

    before = names(folder)
    writable = semdb("status", "--database-url", url)[1]
    (code, out, err), (_, csv, _), refined = where_nothing_can_be_written(look, folder)
    assert (code, out) == (0, writable)
    assert err == (
        f"semdb: the database {path} is read only: its medium, or the rights of the file, its folder or the files "
        "beside it, allow no writing\n"
    )
    assert len(csv.splitlines()) == 61
    assert refined[0] == 1
    assert "cannot be written: check the rights" in refined[2]
    assert names(folder) == before


def test_the_latest_changes_of_a_file_are_never_left_out(folder: Path, file: Path) -> None:
    """A copy that was made while the database was in use, on a medium that cannot be written."""
    copy = folder / "copy"
    copy.mkdir()
    with open_store(f"sqlite:///{file}") as store:
        store.ensure_map("late")
        for ending in ("", "-wal", "-shm"):
            shutil.copy(f"{file}{ending}", copy / f"{file.name}{ending}")
    path = copy / file.name
    os.chmod(copy, 0o555)

    def maps() -> list[str]:
        with open_store(f"sqlite:///{path}") as store:
            return [info.name for info in store.maps()]

    def refused() -> str:
        with pytest.raises(DatabaseError) as caught:
            maps()
        return str(caught.value)

    assert as_somebody_else(maps) == ["room", "late"]  # with the index beside it
    os.chmod(copy, 0o755)
    (copy / f"{file.name}-shm").unlink()
    os.chmod(copy, 0o555)
    message = as_somebody_else(refused)
    assert f"its latest changes are in {file.name}-wal" in message
    assert "semdb status" in message
    os.chmod(copy, 0o755)
    assert maps() == ["room", "late"]


def test_a_file_that_changes_while_it_is_taken_for_immutable(folder: Path, file: Path) -> None:
    give(OTHER, file, folder)
    url = f"sqlite:///{file}"

    def rename(name: str) -> None:
        with closing(sqlite3.connect(file)) as connection:
            connection.execute("UPDATE maps SET name = ?", (name,))
            connection.commit()

    def look() -> list[list[str]]:
        found = []
        with open_store(url) as store:
            found.append([info.name for info in store.maps()])
            os.seteuid(0)
            rename("kitchen")
            os.seteuid(NOBODY)
            found.append([info.name for info in store.maps()])
        return found

    look_once: list[str] = []

    def torn(connection: Any) -> str:
        """Renamed by the owner in the middle of the first attempt."""
        found = str(connection.exec_driver_sql("SELECT name FROM maps").scalar())
        if not look_once:
            look_once.append(found)
            os.seteuid(0)
            rename("hall")
            os.seteuid(NOBODY)
        return found

    def read() -> tuple[str, Opening]:
        from semdb.database import retry

        with open_store(url) as store:
            return retry.read(store.engine, torn), opening_of(file)

    def partly(function: Callable[[], Any]) -> Any:
        """As another user that can become root for a moment."""

        def run() -> Any:
            os.setegid(NOBODY)
            os.seteuid(NOBODY)
            return function()

        return as_somebody_else(run, user=0)

    assert partly(look) == [["room"], ["kitchen"]]
    assert partly(read) == ("hall", Opening.IMMUTABLE)
    assert names(folder) == ["maps.sqlite3"]


def test_a_database_that_is_deleted_or_replaced_meanwhile(folder: Path, file: Path) -> None:
    url = f"sqlite:///{file}"
    other = folder / "other.sqlite3"
    with open_store(f"sqlite:///{other}", create=True) as store:
        store.ensure_map("another")
    with open_store(url) as store:
        assert len(store.maps()) == 1
        other.rename(file)
        with pytest.raises(DatabaseError, match=r"was replaced by another file while it was in use: start again"):
            store.maps()
        file.unlink()
        for _ in range(2):
            with pytest.raises(DatabaseError, match=r"was deleted while it was in use: start again"):
                store.ensure_map("new")
        store.engine.dispose()  # all connections are new
        with pytest.raises(DatabaseError, match=r"was deleted while it was in use"):
            store.ensure_map("new")
    assert not file.exists()


def test_paths_that_name_no_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuses(url: str, kind: type[Exception], *, create: bool = True) -> str:
        with pytest.raises(kind) as caught:
            open_store(url, create=create)
        return str(caught.value)

    folder = tmp_path / "folder"
    folder.mkdir()
    assert f"{folder} is a folder: give a file in it, as sqlite:///{folder}/semdb.sqlite3" in refuses(
        f"sqlite:///{folder}", UsageError
    )
    os.mkfifo(tmp_path / "pipe")
    assert "is no regular file" in refuses(f"sqlite:///{tmp_path / 'pipe'}", UsageError)
    assert "is no regular file" in refuses("sqlite:////dev/null", UsageError)
    for url in (
        "sqlite:///file:x?mode=memory&uri=true",
        "sqlite:///a.sqlite3?mode=ro",
        f"sqlite:///{tmp_path}/#1 ?/a.sqlite3",
        "sqlite:///a?",
    ):
        assert "has parameters" in refuses(url, UsageError)
    assert "has a host" in refuses("sqlite://tmp/a.sqlite3", UsageError)
    assert "NUL" in refuses("sqlite:///a\0b.sqlite3", UsageError)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.sqlite3").touch()
    hint = refuses(f"sqlite://{tmp_path / 'there.sqlite3'}", SchemaError, create=False)
    assert hint.endswith(f"takes a fourth slash: sqlite:///{tmp_path / 'there.sqlite3'}")
    assert sorted(os.listdir(tmp_path)) == ["folder", "pipe", "there.sqlite3"]


def test_names_are_taken_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "home").mkdir()
    (tmp_path / "sp ace").mkdir()
    for name, path in (
        ("~/a.sqlite3", tmp_path / "home" / "a.sqlite3"),
        ("sp ace/#1 ä&c.sqlite3", tmp_path / "sp ace" / "#1 ä&c.sqlite3"),
        ("sp ace/%3F%20%25.sqlite3", tmp_path / "sp ace" / "? %.sqlite3"),
        ("file:x", tmp_path / "file:x"),
        ("b~.sqlite3", tmp_path / "b~.sqlite3"),
        (os.fsdecode(b"\xff\xfe.sqlite3"), tmp_path / os.fsdecode(b"\xff\xfe.sqlite3")),
    ):
        with open_store(f"sqlite:///{name}", create=True) as store:
            store.ensure_map("room")
        assert path.is_file()
        with open_store(f"sqlite:///{name}") as store:
            assert make_engine(store.url).url.database == parse_url(f"sqlite:///{name}").database
            assert [info.name for info in store.maps()] == ["room"]
    assert parse_url("sqlite:///~/a.sqlite3").database == str(tmp_path / "home" / "a.sqlite3")


def test_files_of_other_programs_are_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "photos.sqlite3"
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("CREATE TABLE images (id INTEGER)")
    before = path.read_bytes()
    with pytest.raises(SchemaError, match=r"no semdb database \(tables images\): give semdb a file of its own"):
        open_store(f"sqlite:///{path}", create=True)
    assert path.read_bytes()[100:] == before[100:]  # but for the header's counters
    empty = tmp_path / "empty.sqlite3"
    empty.touch()
    with pytest.raises(SchemaError, match="no semdb schema"):
        open_store(f"sqlite:///{empty}")
    open_store(f"sqlite:///{empty}", create=True).close()


def test_schemas_of_servers_may_be_shared_but_no_name(server_url: str) -> None:
    engine = make_engine(server_url)
    with engine.connect() as connection:
        connection.exec_driver_sql("CREATE TABLE photos (id INTEGER PRIMARY KEY)")
        connection.exec_driver_sql("CREATE TABLE maps (id INTEGER PRIMARY KEY)")
    code, _, err = semdb("init", "--database-url", server_url)
    assert code == 1
    assert "no semdb database (tables maps): give semdb a schema of its own" in err
    assert current_revision(engine) is None
    with engine.connect() as connection:
        connection.exec_driver_sql("DROP TABLE maps")
    engine.dispose()
    assert semdb("init", "--database-url", server_url)[0] == 0


def test_how_it_is_read(file: Path, folder: Path) -> None:
    assert how_it_is_read(file) is None
    assert how_it_is_read(folder / "new.sqlite3") is None
    give(OTHER, file)
    assert as_somebody_else(lambda: opening_of(file)) == Opening.IMMUTABLE
    os.chmod(file, 0o600)

    def refused() -> str:
        with pytest.raises(DatabaseError) as caught:
            opening_of(file)
        return str(caught.value)

    assert as_somebody_else(refused) == f"the database {file} cannot be read: check the rights of the file"


@pytest.mark.parametrize(
    "arguments",
    [
        ["ingest", "somewhere", "--map", ""],
        ["ingest", "", "--map", "m"],
        ["localize", "a.png", "--map", ""],
        ["localize", "a.png", "--like", ""],
        ["localize", "a.png", "--plot", ""],
        ["localize", "a.png", "", "--map", "m"],
        ["status", "--map", ""],
        ["status", "--database-url", ""],
        ["delete", "recording", "a", "--map", ""],
        ["delete", "map", ""],
        ["models", "list", "--database-url", ""],
        ["sql", ""],
    ],
)
def test_empty_values_are_refused(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = semdb(*arguments)
    assert (code, out) == (2, "")
    before = arguments[arguments.index("") - 1]
    name = before if before.startswith("--") else ""
    assert err.startswith(f"semdb: {name}")
    assert err.endswith(": the value is empty; give one, or leave it out\n")
    assert list(tmp_path.iterdir()) == []
