"""Commands against a server: schema, accounts, read-only SQL."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from typing import Any

import pytest
from sqlalchemy.engine import make_url
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database.store import open_store
from tests.database_samples import fill
from tests.servers import TestServer

FOREIGN = {"mysql": "utf8mb4_0900_ai_ci", "mariadb": "utf8mb4_general_ci"}  # what CREATE DATABASE gives


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


def test_passwords_are_rotated(
    accounts: dict[str, str], server_url: str, database_server: TestServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The old ones end; where an account is missing, what was changed before is not lost."""
    run("init", "--database-url", accounts["owner"])
    output = run("init", "--accounts", "--execute", "--rotate", "--database-url", server_url).stdout
    assert output.startswith("changed the passwords of the accounts; nothing else remembers their passwords:\n")
    rotated = {line.split()[0]: line.split()[-1] for line in output.splitlines()[1:]}
    for role, url in rotated.items():
        old, new = make_url(accounts[role]), make_url(url)
        assert (old.username, old.database) == (new.username, new.database)
        assert old.password != new.password
    monkeypatch.setenv("SEMDB_DATABASE_URL", rotated["writer"])
    assert json.loads(run("status", "--json").stdout) == []
    assert "check user, password" in run("status", "--database-url", accounts["writer"], code=1).stderr

    reader = make_url(rotated["reader"]).username
    database_server.execute(f"DROP USER '{reader}'@'%'")
    refused = run("init", "--accounts", "--execute", "--rotate", "--database-url", server_url, code=1).stderr
    flat = " ".join(refused.split())
    assert f"there is no account '{reader}'@'%', whose password could be changed: leave out --rotate" in flat
    changed = re.findall(r"ALTER USER '(\S+)'@'%' IDENTIFIED BY '(\S+)'", flat)
    assert [name for name, _ in changed] == [make_url(rotated[role]).username for role in ("owner", "writer")]
    writer = make_url(rotated["writer"]).set(password=changed[1][1]).render_as_string(hide_password=False)
    assert json.loads(run("status", "--json", "--database-url", writer).stdout) == []
    run("init", "--reader", "--execute", "--database-url", server_url)


def test_accounts_of_several_schemas_and_of_one_that_is_not_there_yet(database_server: TestServer) -> None:
    """None is left behind of a run that a later statement ends."""
    names = [f"semdb_{os.getpid()}_{n}" for n in (1, 2)]
    urls = [database_server.admin.set(database=name).render_as_string(hide_password=False) for name in names]
    try:
        for url in urls:
            output = run("init", "--accounts", "--execute", "--database-url", url).stdout
            owner = next(line.split()[-1] for line in output.splitlines() if line.startswith("owner"))
            assert "created the schema" in run("init", "--database-url", owner).stdout
        again = " ".join(run("init", "--accounts", "--execute", "--database-url", urls[0], code=1).stderr.split())
        assert f"'{names[0]}_owner'@'%' is there already, and no account was made: --rotate" in again

        database_server.execute(*(f"DROP USER '{names[1]}_{role}'@'%'" for role in ("owner", "writer")))
        run("init", "--accounts", "--execute", "--database-url", urls[1], code=1)  # the reader is there
        users = database_server.execute(f"SELECT user FROM mysql.user WHERE user LIKE '{names[1]}%'")
        assert [str(user) for (user,) in users] == [f"{names[1]}_reader"]
    finally:
        for name in names:
            database_server.execute(f"DROP DATABASE IF EXISTS `{name}`")
            database_server.execute(
                *(f"DROP USER IF EXISTS '{name}_{role}'@'%'" for role in ("owner", "writer", "reader"))
            )


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


def test_the_collation_of_a_schema_becomes_binary(database_server: TestServer, server_url: str) -> None:
    """As a schema has it that was made by CREATE DATABASE alone."""
    name, foreign = make_url(server_url).database, FOREIGN[database_server.kind]
    database_server.execute(f"ALTER DATABASE `{name}` CHARACTER SET utf8mb4 COLLATE {foreign}")
    first, second = run("init", "--database-url", server_url).stdout.splitlines()
    assert first.startswith(f"changed the collation of the schema from {foreign} to utf8mb4_bin, ")
    assert second.startswith("created the schema")
    assert _collations(database_server, str(name)) == {"utf8mb4_bin"}
    assert run("init", "--database-url", server_url).stdout.startswith("the schema of ")


def test_a_collation_that_may_not_be_changed_is_refused_before_anything_is_made(
    database_server: TestServer, server_url: str
) -> None:
    name, foreign = make_url(server_url).database, FOREIGN[database_server.kind]
    alter = f"ALTER DATABASE `{name}` CHARACTER SET utf8mb4 COLLATE "
    database_server.execute(alter + foreign, "CREATE USER 'bound'@'127.0.0.1' IDENTIFIED BY 'x'")
    try:
        rights = "SELECT, INSERT, UPDATE, DELETE, CREATE, DROP, INDEX, REFERENCES, CREATE VIEW, SHOW VIEW"  # no ALTER
        database_server.execute(f"GRANT {rights} ON `{name}`.* TO 'bound'@'127.0.0.1'")
        bound = make_url(server_url).set(username="bound", password="x").render_as_string(hide_password=False)
        refused = " ".join(run("init", "--database-url", bound, code=1).stderr.split())
        assert f"has the collation {foreign}, which takes different names for the same" in refused
        assert f"run `{alter}utf8mb4_bin;` as one that may, and `semdb init` again" in refused
        assert database_server.execute(f"SHOW TABLES IN `{name}`") == []
        run("init", "--database-url", server_url)
        database_server.execute(alter + foreign)  # its tables name their own
        assert "is up to date" in run("init", "--database-url", bound).stdout
    finally:
        database_server.execute("DROP USER 'bound'@'127.0.0.1'")


def _collations(server: TestServer, name: str) -> set[object]:
    """Of a schema and of all text in its tables."""
    schema = f"SELECT default_collation_name FROM information_schema.schemata WHERE schema_name = '{name}'"
    columns = (
        "SELECT DISTINCT c.collation_name FROM information_schema.columns c JOIN information_schema.tables t "
        "USING (table_schema, table_name) WHERE c.collation_name IS NOT NULL AND t.table_type = 'BASE TABLE' "
        f"AND c.table_schema = '{name}'"
    )
    return {row[0] for query in (schema, columns) for row in server.execute(query)}
