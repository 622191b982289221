"""`semdb sql` and the accounts: reading works, and the database itself refuses everything else."""

from __future__ import annotations

import contextlib
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import SQLAlchemyError

from semdb.database import accounts, schema
from semdb.database.catalogue import ask, tables_and_columns
from semdb.database.engine import make_engine
from semdb.database.readonly import run_readonly
from semdb.database.readonly_server import excess_rights
from semdb.database.statement import HIDDEN
from semdb.database.store import Store, open_store
from semdb.database.tables import metadata
from semdb.errors import DatabaseError, SchemaError, UsageError
from semdb.settings import Settings
from tests.database_samples import MODELS, description, fill, plan, record
from tests.rooms import semdb
from tests.servers import TestServer

WRITES = [
    "CREATE TABLE stolen (id INTEGER)",
    "INSERT INTO maps (name) VALUES ('x')",
    "UPDATE maps SET name = 'x'",
    "DELETE FROM maps",
    "DROP TABLE maps",
    "REPLACE INTO maps (id, name) VALUES (1, 'x')",
    "WITH x AS (SELECT 1) DELETE FROM maps",
    "EXPLAIN SELECT 1; DELETE FROM maps",
    "SELECT 1; DELETE FROM maps",
    "SELECT 1; CREATE TABLE stolen (id INTEGER)",
    "/* SELECT */ DELETE FROM maps",
    "-- SELECT\nDELETE FROM maps",
    "(DELETE FROM maps)",
    "COMMIT",
    "ROLLBACK",
    "SET SESSION TRANSACTION READ WRITE",
    "CALL mysql.anything()",
    "GRANT ALL ON *.* TO me",
    "LOAD DATA INFILE '/etc/passwd' INTO TABLE maps",
    "VACUUM",
    "VACUUM INTO '{folder}/copy'",
    "ATTACH DATABASE '{folder}/attached' AS other",
    "PRAGMA user_version = 7",
    "PRAGMA query_only = OFF",
    "PRAGMA writable_schema = ON",
    "SELECT * FROM pragma_table_info('maps')",
    "SELECT load_extension('{folder}/x')",
    "SELECT name FROM maps INTO OUTFILE '{folder}/outfile'",
    "SELECT name FROM maps LIMIT 1 INTO DUMPFILE '{folder}/dumpfile'",
    "SELECT * FROM maps FOR UPDATE",
    "SET STATEMENT max_statement_time = 0 FOR SELECT 1",
    "/*!50000 SET GLOBAL max_connections = 1 */",
    "/*M!100100 DELETE FROM maps */",
    "SELECT 1 /*! INTO OUTFILE '{folder}/hidden' */",
    "",
    ";",
]


@contextlib.contextmanager
def reader_of(server: TestServer, url: str, *extra: str) -> Iterator[str]:
    """The URL of a reader account that `semdb init --accounts` would make, with more rights where given."""
    made = accounts.plan_accounts(url, names={role: f"{role}_{id(server) % 10**6}" for role in accounts.ROLES})
    names = [str(make_url(account).username) for account in made.urls.values()]
    accounts.execute(url, made.statements)
    try:
        server.execute(*(right.format(account=f"'{names[2]}'@'%'") for right in extra))
        yield made.urls["reader"]
    finally:
        server.execute(*(f"DROP USER IF EXISTS '{name}'@'%'" for name in names))


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that the server's user could write into, which one below pytest's own is not."""
    with tempfile.TemporaryDirectory(dir="/tmp") as name:
        os.chmod(name, 0o777)
        yield Path(name)


@pytest.fixture
def settings(store: Store, database_url: str, server_of_url: TestServer | None) -> Iterator[Settings]:
    """Settings as `semdb sql` has them, with data in the database."""
    fill(store)
    if server_of_url is None:
        yield Settings(database_url=database_url, sql_time_limit_s=20)
        return
    with reader_of(server_of_url, database_url) as reader:
        yield Settings(database_url=database_url, reader_url=reader, sql_time_limit_s=20)


def test_queries_give_columns_and_rows(settings: Settings) -> None:
    columns, rows = run_readonly(
        settings, "SELECT map, SUM(keypoints) AS total, 'a%b;' AS text FROM keypoint_counts GROUP BY map;"
    )
    assert columns == ("map", "total", "text")
    assert list(rows) == [("room", 300, "a%b;")]
    _, rows = run_readonly(settings, "-- comment\n/* another */ SELECT 1.5, NULL, -2")
    assert list(rows) == [(1.5, None, -2)]
    _, rows = run_readonly(
        settings,
        "WITH RECURSIVE n AS (SELECT 1 AS i UNION ALL SELECT i + 1 FROM n WHERE i < 900) SELECT i FROM n ORDER BY i",
    )
    assert [i for (i,) in rows] == list(range(1, 901))
    _, rows = run_readonly(settings, "SELECT rgb FROM keyframe_images ORDER BY keyframe_id")
    assert next(rows)[0] == record(0, description(0)).image_bytes
    rows.close()


def test_rows_are_fetched_as_they_are_asked_for(settings: Settings) -> None:
    forever = "WITH RECURSIVE n AS (SELECT 1 AS i UNION ALL SELECT i + 1 FROM n WHERE i < 3000000) SELECT i FROM n"
    if "mysql" in settings.database_url:
        forever = "SELECT a.id FROM objects a, objects b, objects c, objects d, objects e"
    _, rows = run_readonly(settings, forever)
    assert isinstance(next(rows)[0], int)
    rows.close()


@pytest.mark.parametrize("checked", [True, False], ids=["with the check of the first word", "by the database alone"])
def test_whatever_is_not_reading_is_refused(
    settings: Settings, store: Store, open_folder: Path, checked: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not checked:
        monkeypatch.setattr("semdb.database.readonly._check_statement", lambda *_, **__: None)
    server = store.engine.dialect.name != "sqlite"
    before = _state(store)
    passed = set()
    for statement in WRITES:
        try:
            list(run_readonly(settings, statement.format(folder=open_folder))[1])
            passed.add(statement)
        except (DatabaseError, UsageError):
            pass
        assert _state(store) == before, statement
        assert list(open_folder.iterdir()) == [], statement
    # What passes changes nothing that outlives its connection: a lock until the end, a limit of its own, a comment.
    harmless = {"SELECT * FROM maps FOR UPDATE"} if server else {"SELECT 1 /*! INTO OUTFILE '{folder}/hidden' */"}
    if server and not checked:
        harmless |= {"SET STATEMENT max_statement_time = 0 FOR SELECT 1"}
    assert passed <= harmless
    _, rows = run_readonly(settings, "SELECT name FROM maps")
    assert list(rows) == [("room",)]


def _state(store: Store) -> object:
    query = "SELECT COUNT(*), MIN(name), MAX(name) FROM maps"
    tables = "SELECT COUNT(*) FROM sqlite_master"
    if store.engine.dialect.name != "sqlite":
        tables = "SELECT COUNT(*) FROM information_schema.tables WHERE table_schema = DATABASE()"
    with store.engine.connect() as connection:
        return [tuple(connection.execute(text(statement)).one()) for statement in (query, tables)]


def test_slow_queries_are_ended(settings: Settings) -> None:
    hurried = settings.model_copy(update={"sql_time_limit_s": 0.3})
    # MySQL counts a product of tables without making it
    slow = "SELECT SUM(a.score * h.score) FROM " + ", ".join(f"objects {name}" for name in "abcdefgh")
    began = time.monotonic()
    with pytest.raises(DatabaseError, match=r"longer than 0\.3 s .*SEMDB_SQL_TIME_LIMIT_S"):
        list(run_readonly(hurried, slow)[1])
    assert time.monotonic() - began < 15  # without the limit: hours


def test_mistakes_are_told(settings: Settings) -> None:
    with pytest.raises(DatabaseError, match=r"refused the statement.*no_such_table"):
        run_readonly(settings, "SELECT * FROM no_such_table")
    with pytest.raises(DatabaseError, match=r"refused the statement.*landmark_lst.*; alike are landmark_list"):
        ask(settings, "SELECT * FROM landmark_lst")
    with pytest.raises(DatabaseError, match=r"refused the statement.*; \\d in `semdb sql` lists tables and views$"):
        ask(settings, "SELECT * FROM zzzzzz")
    with pytest.raises(UsageError, match="only queries can be run here"):
        run_readonly(settings, "DELETE FROM maps")


def test_a_sqlite_file_that_is_not_there_is_not_made(tmp_path: Path) -> None:
    with pytest.raises(SchemaError, match="no database"):
        run_readonly(Settings(database_url=f"sqlite:///{tmp_path / 'a.sqlite3'}"), "SELECT 1")
    assert list(tmp_path.iterdir()) == []


def test_a_server_needs_a_reader(server_url: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"SEMDB_READER_URL.*semdb init --reader --execute .*ADMIN:PASSWORD@") as told:
        run_readonly(Settings(database_url=server_url, reader_url=None), "SELECT 1")
    assert str(make_url(server_url).database) in str(told.value)
    file = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with pytest.raises(UsageError, match="names a SQLite file"):
        run_readonly(Settings(database_url=server_url, reader_url=file), "SELECT 1")


def test_the_command_that_the_error_names_makes_a_reader(database_server: TestServer, server_url: str) -> None:
    """Where the writer's account is the only one: the command as it is printed, as one that may make others."""
    engine = make_engine(server_url)
    schema.upgrade(engine)
    engine.dispose()
    refused = semdb("sql", "SELECT 1", url=server_url)
    assert refused.returncode == 2
    named = refused.stderr.rpartition("semdb init")[2].split()
    admin = make_url(server_url)
    assert [*named[:-1]] == ["--reader", "--execute", "--database-url"]
    assert named[-1] == admin.set(username="ADMIN", password="PASSWORD", query={}).render_as_string(hide_password=False)
    try:
        printed = semdb("init", "--reader", url=server_url).stdout
        account = accounts.account_name(str(admin.database), "reader")
        assert printed.startswith(f"CREATE USER '{account}'@'%'")
        assert "_writer" not in printed
        made = semdb("init", *named[:-1], server_url, url="sqlite:///nothing.sqlite3")
        assert made.returncode == 0, made.stderr
        assert made.stdout.startswith(
            "created the account; nothing else remembers its password:\nreader (SEMDB_READER_URL)"
        )
        reader = made.stdout.split()[-1]
        done = semdb("sql", "SELECT 1 AS one", url=server_url, SEMDB_READER_URL=reader)
        assert done.stdout == "one\n---\n  1\n"
        known = tables_and_columns(Settings(database_url=server_url, reader_url=reader))
        shown = [table for table in metadata.tables.values() if table.name not in HIDDEN]
        assert "access_tokens" not in known
        for table in shown:
            assert known[table.name] == tuple(column.name for column in table.columns)
        assert "category" in known["keyframe_objects"]
        for name in ("access_tokens", "`access_tokens`", "ACCESS_TOKENS", "access_to\u212aens"):
            with pytest.raises(UsageError, match="access_tokens is not shown here"):
                run_readonly(Settings(database_url=server_url, reader_url=reader), f"SELECT hash FROM {name}")
    finally:
        database_server.execute(f"DROP USER IF EXISTS '{accounts.account_name(str(admin.database), 'reader')}'@'%'")


@pytest.mark.parametrize(
    ("grant", "named"),
    [
        ("GRANT FILE ON *.* TO {account}", "FILE"),
        ("GRANT INSERT ON mysql.* TO {account}", "INSERT"),
        ("GRANT ALL ON *.* TO {account}", "(ALL PRIVILEGES|SUPER)"),  # MySQL names each
        ("GRANT SELECT ON *.* TO {account} WITH GRANT OPTION", "GRANT OPTION"),
    ],
)
def test_an_account_that_may_do_more_is_refused(
    database_server: TestServer, server_url: str, grant: str, named: str
) -> None:
    with reader_of(database_server, server_url, grant) as reader:
        settings = Settings(database_url=server_url, reader_url=reader)
        with pytest.raises(DatabaseError, match=f"may do more than read .*{named}") as caught:
            run_readonly(settings, "SELECT 1")
    assert str(make_url(reader).password) not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "extra"),
    [
        ("GRANT USAGE ON *.* TO `r`@`%` IDENTIFIED BY PASSWORD '*AB'", []),
        ("GRANT SELECT, SHOW VIEW ON `semdb`.* TO `r`@`%`", []),
        ("GRANT SELECT (`id`, `name`), UPDATE (`a`, `b`) ON `s`.`t` TO `r`@`%`", ["UPDATE"]),
        ("GRANT SELECT, FILE ON *.* TO `r`@`%`", ["FILE"]),
        ("GRANT SELECT ON `s`.* TO `r`@`%` WITH GRANT OPTION", ["GRANT OPTION"]),
        ("GRANT USAGE ON *.* TO `r`@`%` WITH MAX_USER_CONNECTIONS 2", []),
        ("GRANT `writers`@`%` TO `r`@`%`", ["`writers`@`%` (a role or proxy)"]),
        ("GRANT EXECUTE ON PROCEDURE `s`.`p` TO `r`@`%`", ["EXECUTE ON PROCEDURE `s`.`p` (a role or proxy)"]),
    ],
)
def test_grants_are_read(line: str, extra: list[str]) -> None:
    assert excess_rights(line) == extra


def test_each_account_can_do_its_work_and_no_more(database_server: TestServer, server_url: str) -> None:
    names = {role: f"acc_{role}" for role in accounts.ROLES}
    secret = "it's %d & <odd>"
    made = accounts.plan_accounts(server_url, names=names, passwords={"owner": secret})
    assert make_url(made.urls["owner"]).password == secret
    assert len({make_url(url).password for url in made.urls.values()}) == 3
    accounts.execute(server_url, made.statements)
    try:
        owner = make_engine(made.urls["owner"])
        schema.upgrade(owner)
        schema.downgrade(owner)
        schema.upgrade(owner)
        owner.dispose()
        with open_store(made.urls["writer"]) as store:
            map_id, recording_id, ids = fill(store)
            store.load_keyframes(ids)
            planned = store.plan_recording(map_id, plan("second", [1]), MODELS)
            assert store.write_keyframe(planned.recording_id, record(1, description(1))).created
            store.delete_recording(recording_id)
        writer = make_engine(made.urls["writer"])
        with pytest.raises(DatabaseError, match="refuses"):
            schema.downgrade(writer)
        writer.dispose()
        settings = Settings(database_url=made.urls["writer"], reader_url=made.urls["reader"])
        assert list(run_readonly(settings, "SELECT keyframes FROM recording_summary")[1]) == [(1,)]
        assert len(list(run_readonly(settings, "SELECT object_id FROM keyframe_objects")[1])) == len(
            description(1).detections
        )
        with open_store(made.urls["reader"]) as store, pytest.raises(DatabaseError, match="refuses"):
            store.ensure_map("x")
        # the pattern characters in the schema's name are not patterns in the grants
        other = database_server.admin.set(database=str(make_url(server_url).database).replace("_", "x"))
        database_server.execute(f"CREATE DATABASE `{other.database}`")
        try:
            stranger = make_url(made.urls["reader"]).set(database=other.database)
            with pytest.raises(DatabaseError, match="refuses"):
                open_store(stranger.render_as_string(hide_password=False))
        finally:
            database_server.execute(f"DROP DATABASE `{other.database}`")
        with pytest.raises(DatabaseError, match="acc_owner"):
            accounts.execute(server_url, made.statements)
    finally:
        database_server.execute(*(f"DROP USER IF EXISTS '{name}'@'%'" for name in names.values()))


def test_the_reader_cannot_read_tokens(database_server: TestServer, server_url: str) -> None:
    """Neither one that is made now, before the schema is, nor one that could, once it gets this version's rights."""
    name = str(make_url(server_url).database)
    account = f"'{accounts.account_name(name, 'reader')}'@'%'"
    made = accounts.plan_accounts(server_url, roles=("reader",))
    accounts.execute(server_url, made.statements)

    def seen() -> set[str]:
        engine = make_engine(made.urls["reader"])
        with engine.connect() as connection:
            found = {row[0] for row in connection.exec_driver_sql("SHOW TABLES")}
            for table in sorted(found):
                connection.exec_driver_sql(f"SELECT 1 FROM `{table}` LIMIT 1")
            connection.exec_driver_sql("SHOW CREATE VIEW keyframe_objects")
        engine.dispose()
        return found

    try:
        schema.upgrade(make_engine(server_url))
        there = {row[0] for row in database_server.execute(f"SHOW TABLES IN `{name}`")}
        assert seen() == there - {"access_tokens", "service_jobs"}
        for refused in ("SELECT hash FROM access_tokens", "CREATE TABLE mine (a INT)", "DROP TABLE maps"):
            with pytest.raises(SQLAlchemyError), make_engine(made.urls["reader"]).connect() as connection:
                connection.exec_driver_sql(refused)
        whole = name.replace("_", "\\_")  # as earlier versions did it
        database_server.execute(f"GRANT SELECT, SHOW VIEW ON `{whole}`.* TO {account}")
        assert "access_tokens" in seen()
        accounts.execute(server_url, accounts.plan_accounts(server_url, roles=("reader",), grants=True).statements)
        assert seen() == there - {"access_tokens", "service_jobs"}
        with make_engine(made.urls["reader"]).connect() as connection:
            grants = [str(row[0]) for row in connection.exec_driver_sql("SHOW GRANTS")]
        assert [right for grant in grants for right in excess_rights(grant)] == []
    finally:
        database_server.execute(f"DROP USER IF EXISTS {account}")


def test_accounts_that_cannot_be_made(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="SQLite has no accounts"):
        accounts.plan_accounts(f"sqlite:///{tmp_path / 'a.sqlite3'}")
    url = "mysql+pymysql://root@127.0.0.1/semdb"
    with pytest.raises(UsageError, match="cannot be the name of an account"):
        accounts.plan_accounts(url, names={"reader": "x'; DROP TABLE maps; --"})
    with pytest.raises(UsageError, match="no host for an account"):
        accounts.plan_accounts(url, host="a'b")
    with pytest.raises(UsageError, match="no backslash"):
        accounts.plan_accounts(url, passwords={"owner": "a\\"})
    made = accounts.plan_accounts(url, passwords=dict.fromkeys(accounts.ROLES, "p'w"))
    assert made.statements[1] == "CREATE USER 'semdb_owner'@'%' IDENTIFIED BY 'p''w'"
    assert made.statements[-1] == "REVOKE CREATE ON `semdb`.`recording_pose_errors` FROM 'semdb_reader'@'%'"
    assert not any("access_tokens" in statement or "service_jobs" in statement for statement in made.statements)
    again = accounts.plan_accounts(url, roles=("reader",), grants=True)
    assert again.statements[0] == "GRANT SELECT, SHOW VIEW ON `semdb`.* TO 'semdb_reader'@'%'"
    assert again.statements[1] == "REVOKE SELECT, SHOW VIEW ON `semdb`.* FROM 'semdb_reader'@'%'"
    assert again.urls == {}


@pytest.mark.parametrize(
    ("schema", "name"),
    [
        ("semdb", "semdb_reader"),
        ("maps", "maps_reader"),
        ("a" * 25, "a" * 25 + "_reader"),
        ("a" * 26, "a" * 16 + "_9976d549_reader"),
        ("maps/1", "maps_1_bc366e61_reader"),
        ("karten von köln", "karten_von_k_ln_043dacd5_reader"),
    ],
)
def test_accounts_are_named_after_the_schema(schema: str, name: str) -> None:
    """Within the 32 characters that MySQL takes, whatever the schema is called."""
    assert accounts.account_name(schema, "reader") == name
    assert {len(accounts.account_name("m" * n, "writer")) <= 32 for n in range(1, 65)} == {True}
