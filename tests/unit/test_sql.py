"""`semdb sql` beside its rows: where statements end, what a blob is called, pipes, files and the prompt."""

from __future__ import annotations

import json
import os
import stat
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.cli.sql_prompt import completions
from semdb.cli.sql_text import statements
from semdb.database import codecs
from semdb.database.blob_text import describe_blob, size_text
from semdb.database.catalogue import tables_and_columns
from semdb.database.readonly import run_readonly
from semdb.database.statement import HIDDEN
from semdb.database.store import open_store
from semdb.database.tables import metadata
from semdb.errors import DatabaseError
from semdb.settings import Settings
from semdb.types import Features, Keypoints
from tests.database_samples import fill
from tests.terminal import Terminal


@pytest.fixture(autouse=True)
def _database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with open_store("sqlite:///semdb.sqlite3", create=True) as store:
        fill(store)


def run(*arguments: str, piped: str | bytes | None = None, code: int = 0) -> Any:
    result = CliRunner().invoke(app, ["sql", *arguments], input=piped)
    assert result.exit_code == code, f"{result.exit_code}: {result.output}{result.exception!r}"
    return result


# statements


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("SELECT 1", [("SELECT 1", 1, False)]),
        ("SELECT 1;", [("SELECT 1", 1, True)]),
        ("\n\n  SELECT\n1 ; ;SELECT 2", [("SELECT\n1", 3, True), ("SELECT 2", 4, False)]),
        ("-- a; b\nSELECT ';' /* ; */ FROM x;", [("-- a; b\nSELECT ';' /* ; */ FROM x", 2, True)]),
        ("SELECT \"a;b\", 'it''s;', `c;d`;", [("SELECT \"a;b\", 'it''s;', `c;d`", 1, True)]),
        ("SELECT 'say \"hi;\"'; SELECT 2", [("SELECT 'say \"hi;\"'", 1, True), ("SELECT 2", 1, False)]),
        ("SELECT 'open; ", [("SELECT 'open;", 1, False)]),
        ("SELECT 1 - 2 / 3", [("SELECT 1 - 2 / 3", 1, False)]),
        ("-- nothing;\n; /* ; */", []),
        ("", []),
    ],
)
def test_statements_end_at_semicolons_outside_of_quotes(text: str, expected: list[tuple[str, int, bool]]) -> None:
    for backslashes in (False, True):
        found = statements(text, backslashes=backslashes)
        assert [(one.text, one.line, one.ended) for one in found] == expected


def test_backslashes_hide_quotes_on_servers_only() -> None:
    text = r"SELECT 'C:\'; SELECT '2'"
    assert [one.text for one in statements(text, backslashes=False)] == [r"SELECT 'C:\'", "SELECT '2'"]
    assert [one.text for one in statements(text, backslashes=True)] == [text]


@given(st.text(alphabet="aS1 ;'\"`-#/*\\\n", max_size=40), st.booleans())
def test_no_text_is_lost_or_made_up(text: str, backslashes: bool) -> None:
    found = statements(text, backslashes=backslashes)
    position = 0
    for one in found:
        position = text.index(one.text, position) + len(one.text)
        assert one.text
        assert text[: position - len(one.text)].count("\n") + 1 <= one.line <= text[:position].count("\n") + 1
    assert sum(one.ended for one in found) <= text.count(";")


# blobs


def keypoints(count: int) -> Keypoints:
    ones = np.ones(count, np.float32)
    xy = np.arange(2 * count, dtype=np.float32).reshape(-1, 2)
    features = Features(xy, ones, ones, ones, np.ones(count, np.int8), np.zeros((count, 64), np.float32))
    return Keypoints(features, np.full(count, -1, np.int32), np.ones((count, 3), np.float32))


@pytest.mark.parametrize(
    ("blob", "text"),
    [
        (codecs.encode_array(np.zeros(2048, np.float32)), "vector float32[2048], 8.0 KiB"),
        (codecs.encode_array(np.zeros((700, 64), np.float16)), "array float16[700, 64], 87.5 KiB"),
        (codecs.encode_mask(np.eye(480, 640, dtype=bool)), "mask 640x480, 1.9 KiB"),
        (codecs.encode_mask(np.zeros((2, 70000), bool)), "mask 70000x2, 28 bytes"),
        (codecs.encode_keypoints(keypoints(10)), "array float32[10, 9], 380 bytes"),
        (codecs.encode_keypoints(keypoints(10), small=True), "compact keypoints uint16[106], 228 bytes"),
        (cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes(), "png 64x48, 109 bytes"),
        (cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8))[1].tobytes(), "jpeg 64x48, 719 bytes"),
        (b"\xff\xd8\xff\xe0", "jpeg, 4 bytes"),
        (b"", "blob, 0 bytes"),
        (b"x", "blob, 1 byte"),
        (b"SDBA" + bytes(60), "blob, 64 bytes"),
    ],
)
def test_blobs_are_named_by_their_header(blob: bytes, text: str) -> None:
    kind, _, _ = text.rpartition(", ")
    assert describe_blob(blob) == f"{kind}, {size_text(len(blob))}"
    if not kind.startswith(("png", "jpeg")):  # whose sizes are OpenCV's
        assert describe_blob(blob) == text


@given(st.binary(max_size=60), st.sampled_from([b"", b"SDBA", b"SDBM", b"SDBK", b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n"]))
def test_whatever_the_bytes_are_they_have_a_name(data: bytes, magic: bytes) -> None:
    assert describe_blob(magic + data).rpartition(", ")[2] == size_text(len(magic + data))


def test_sizes() -> None:
    assert [size_text(n) for n in (0, 1023, 1024, 8208, 1024**2 - 1, 1024**2, 3 * 1024**3)] == [
        *("0 bytes", "1023 bytes", "1.0 KiB", "8.0 KiB", "1.0 MiB", "1.0 MiB", "3.0 GiB")
    ]


def test_blobs_in_a_table() -> None:
    lines = run("SELECT vector FROM cnn_vectors LIMIT 1").stdout.splitlines()
    assert lines[2] == "vector float32[128], 528 bytes"


# pipes and files


def test_a_pipe_and_a_file_hold_several_statements() -> None:
    text = "SELECT 1 AS a;\n-- the second\nSELECT COUNT(*) AS n FROM keyframes;\n"
    expected = "a\n-\n1\n\nn\n-\n5\n"
    assert run(piped=text).stdout == expected
    Path("questions.sql").write_bytes(b"\xef\xbb\xbf" + text.encode())  # with the mark of some editors
    assert run("--file", "questions.sql").stdout == expected
    assert run("-f", "-", piped=text).stdout == expected
    assert json.loads(run("--format", "json", piped="SELECT 'é' AS a;").stdout) == [{"a": "é"}]


def test_what_columns_of_equal_names_are_called_is_said() -> None:
    result = run("SELECT 1 AS a, 2 AS a", "--format", "json")
    assert json.loads(result.stdout) == [{"a": 1, "a_2": 2}]
    assert result.stderr == "semdb: columns of equal names are numbered: a, a_2\n"
    assert run("SELECT 1 AS a, 2 AS a").stderr == ""


def test_the_line_of_what_fails_is_named() -> None:
    result = run(piped="SELECT 1 AS a;\n\nSELECT nope;\nSELECT 2", code=1)
    assert result.stdout == "a\n-\n1\n\n"
    assert result.stderr.startswith("semdb: standard input, line 3: the database refused the statement: no such column")
    assert "questions.sql, line 1: only queries" in _file("DELETE FROM maps; SELECT 1", code=2)
    assert "no statement in it" in _file("-- nothing\n", code=2)
    assert "2 statements; --format csv takes one" in run("--format", "csv", piped="SELECT 1; SELECT 2", code=2).stderr
    assert "byte 8 is no UTF-8" in run(piped=b"SELECT '\xe9'", code=2).stderr
    assert "not both" in run("SELECT 1", "--file", "questions.sql", code=2).stderr
    assert run("--file", "nowhere.sql", code=1).stderr == "semdb: nowhere.sql: No such file or directory\n"


def _file(text: str, code: int) -> str:
    Path("questions.sql").write_text(text)
    return str(run("--file", "questions.sql", code=code).stderr)


# the prompt

KNOWN = {"keyframes": ("id", "frame_index"), "keyframe_objects": ("category", "score"), "maps": ("id", "name")}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("SELECT * FROM key", ["keyframes", "keyframe_objects"]),
        ("select * from maps m join ", list(KNOWN)),
        ("\\d ma", ["maps"]),
        ("SELECT ca", ["category", "case"]),
        ("SELECT CA", ["CASE"]),
        ("SELECT c", ["category", "case", "count(", "coalesce("]),
        ("SELECT name FROM maps WHERE i", ["id", "in", "is"]),
        ("SELECT k.", []),
        ("SELECT id FROM keyframes AS k WHERE k.f", ["k.frame_index"]),
        ("SELECT id FROM maps, keyframes k WHERE k.f", ["k.frame_index"]),
        ("SELECT maps.n", ["maps.name"]),
        ("SEL", ["SELECT"]),
        ("SELECT id FROM maps GROUP m", ["min(", "max(", "maps"]),
    ],
)
def test_completion_knows_tables_and_columns(line: str, expected: list[str]) -> None:
    word = line.rpartition(" ")[2]
    assert completions(KNOWN, line, word) == expected


def test_the_catalogue_has_every_table_and_view() -> None:
    known = tables_and_columns(Settings(database_url="sqlite:///semdb.sqlite3"))
    shown = [table for table in metadata.tables.values() if table.name not in HIDDEN]
    assert "access_tokens" not in known
    for table in shown:
        assert known[table.name] == tuple(column.name for column in table.columns)
    assert "category" in known["keyframe_objects"]
    assert "alembic_version" not in known
    for name in ("access_tokens", "Access_Tokens", '"access_tokens"', "[access_tokens]", "main.access_tokens"):
        for what in ("*", "COUNT(*)", "1", "hash"):
            with pytest.raises(DatabaseError, match=r"prohibited|not authorized"):
                run_readonly(Settings(), f"SELECT {what} FROM {name}")
    assert not [name for name in known if name.startswith("sqlite")]


def test_the_prompt_on_a_terminal() -> None:
    with Terminal("semdb", "sql") as terminal:
        assert "tables and views; ? for help" in terminal.type("", "semdb> ")
        terminal.type("SELECT frame_ind\t", "frame_index")
        terminal.type(" FROM keyframe_o\t", "keyframe_objects")
        assert "(2 rows, " in terminal.type(" LIMIT 2;\n", "semdb> ")
        terminal.type("SELECT COUNT(*) AS n\n", "...> ")
        terminal.type("FROM keyframes\n", "...> ")
        assert "n\r\n-\r\n5\r\n(1 row, " in terminal.type("\n", "semdb> ")  # an empty line ends it
        assert "no such column: nope" in terminal.type("SELECT nope;\n", "semdb> ")
        assert "only queries can be run here" in terminal.type("DELETE FROM maps;\n", "semdb> ")
        assert "category_counts" in terminal.type("\\d\n", "semdb> ")
        assert "id\r\nname\r\ncreated_at\r\n" in terminal.type("\\d maps\n", "semdb> ")
        assert "no table or view 'nope'" in terminal.type("\\d nope\n", "semdb> ")
        terminal.type("\\f json\n", "semdb> ")
        assert '"a": 1' in terminal.type("SELECT 1 AS a;\n", "semdb> ")
        assert "TAB completes" in terminal.type("?\n", "semdb> ")
        terminal.type("\\f table\n", "semdb> ")
        forever = "WITH RECURSIVE n AS (SELECT 1 AS i UNION ALL SELECT i + 1 FROM n) SELECT i FROM n;\n"
        assert "(the first 1000 rows of more" in terminal.type(forever, "semdb> ")
        terminal.type(forever.replace("SELECT i FROM n;", "SELECT COUNT(*) FROM n;"), "n;\r\n")
        time.sleep(1.5)  # until the statement runs, and not the reading of its line
        assert "semdb: interrupted" in terminal.type("\x03", "semdb> ")
        terminal.type("SELECT 'half", "half")
        # Ctrl-C leaves a line, not the prompt; one that the system hands to another thread waits for the next key
        terminal.type("\x03", "semdb> ", again_s=10)
        assert terminal.end("\x04") == 0
    history = Path(".local/state/semdb/sql_history")
    assert "SELECT COUNT(*) AS n" in history.read_text()
    assert stat.S_IMODE(history.stat().st_mode) == 0o600
    with Terminal("semdb", "sql", XDG_STATE_HOME=os.path.abspath(".local/state")) as terminal:
        terminal.type("", "semdb> ")
        terminal.type("\x10", "half" if "half" in history.read_text() else "COUNT(*) FROM n;")  # the line before
        assert terminal.end("\x15quit\n") == 0


def test_without_a_database_there_is_no_prompt() -> None:
    Path("semdb.sqlite3").unlink()
    with Terminal("semdb", "sql") as terminal:
        assert terminal.end() == 1
        assert "there is no database sqlite:///semdb.sqlite3" in terminal.seen
