"""Commands against a server: schema, accounts, read-only SQL."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy.engine import make_url
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.store import open_store
from tests.database_samples import fill
from tests.servers import TestServer


def run(*arguments: str, code: int = 0) -> Any:
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == code, f"{result.exit_code}: {result.output}{result.exception!r}"
    return result


@pytest.fixture
def accounts(database_server: TestServer, server_url: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, str]]:
    """URLs of the accounts that `semdb init --accounts --execute` made, dropped in the end."""
    for name in [name for name in os.environ if name.startswith("SEMDB_")]:
        monkeypatch.delenv(name)
    output = run("init", "--accounts", "--execute", "--database-url", server_url).stdout
    urls = {line.split()[0]: line.split()[-1] for line in output.splitlines()[1:]}
    yield urls
    database_server.execute(*(f"DROP USER '{make_url(url).username}'@'%'" for url in urls.values()))


def test_each_account_does_its_work_and_no_more(accounts: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert set(accounts) == {"owner", "writer", "reader"}
    assert "created the schema" in run("init", "--database-url", accounts["owner"]).stdout
    assert "up to date" in run("init", "--database-url", accounts["owner"]).stdout

    with open_store(accounts["writer"]) as store:
        fill(store)
    monkeypatch.setenv("SEMDB_DATABASE_URL", accounts["writer"])
    (status,) = json.loads(run("status", "--json").stdout)
    assert (status["recording"], status["keyframes"], status["state"]) == ("first visit", 5, "complete")

    monkeypatch.setenv("SEMDB_READER_URL", accounts["writer"])
    assert "may do more than read" in run("sql", "SELECT 1 AS one", code=1).stderr
    monkeypatch.setenv("SEMDB_READER_URL", accounts["reader"])
    query = "SELECT COUNT(*) AS keyframes, SUM(frame_index) AS frames FROM keyframes"
    assert json.loads(run("sql", query, "--format", "json").stdout) == [{"keyframes": 5, "frames": 42}]
    wrong = make_url(accounts["reader"]).set(password="wrong").render_as_string(hide_password=False)
    monkeypatch.setenv("SEMDB_READER_URL", wrong)
    assert "check user, password and schema of SEMDB_READER_URL" in run("sql", query, code=1).stderr
    monkeypatch.setenv("SEMDB_READER_URL", accounts["reader"])
    assert "refused" in run("sql", "SELECT 1 INTO OUTFILE '/tmp/semdb-never'", code=1).stderr

    assert run("delete", "recording", "first visit", "--yes").stdout.endswith("5 keyframes\n")
    assert json.loads(run("status", "--json").stdout) == []


def test_doctor_names_the_server_and_a_missing_schema(
    accounts: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SEMDB_DATABASE_URL", accounts["owner"])
    result = run("doctor", code=1)
    problems = [line for line in result.stdout.splitlines() if line.startswith("problem")]
    assert len(problems) == 1
    assert "there is no semdb schema" in problems[0]
    run("init")
    assert "answers: server" in run("doctor").stdout
