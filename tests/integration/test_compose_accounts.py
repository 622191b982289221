"""The accounts of docker-compose.yml on a server of the tests' own: what its script says is run, then each is tried."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from semdb.cli.main import app
from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import open_store
from semdb.errors import DatabaseError
from semdb.ingestion.run import IngestOptions, ingest_recordings
from semdb.settings import Settings
from semdb.workers import app as celery_app
from tests import servers

REPOSITORY = Path(__file__).resolve().parents[2]
ROLES = ("owner", "writer", "reader")


@pytest.fixture(scope="module")
def urls(server_kind: servers.Kind, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """A URL for each account, after the script of the composition has made them."""
    folder = tmp_path_factory.mktemp("compose")
    client = folder / "mysql"
    client.write_text('#!/bin/sh\ncat > "$OUT/statements"\n')
    client.chmod(0o755)
    given = {f"SEMDB_{role.upper()}_PASSWORD": f"only4{role}" for role in ROLES}
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "OUT": str(folder), "MYSQL_ROOT_PASSWORD": "r", **given}
    script = REPOSITORY / "scripts" / "compose-accounts.sh"
    subprocess.run(["bash", str(script)], env=environment, check=True, timeout=30)
    options = yaml.safe_load((REPOSITORY / "docker-compose.yml").read_text())["services"]["database"]["command"]
    with servers.server(server_kind, *options) as server:
        server.execute("DROP DATABASE semdb", *filter(None, (folder / "statements").read_text().split(";\n")))
        where = f"127.0.0.1:{server.port}/semdb"
        yield {role: f"mysql+pymysql://semdb_{role}:only4{role}@{where}" for role in ROLES}


def refused(url: str, statement: str) -> None:
    engine = make_engine(url)
    try:
        with engine.connect() as connection, pytest.raises(Exception, match=r"1142|1044|1227|denied"):
            connection.exec_driver_sql(statement)
    finally:
        engine.dispose()


def test_each_account_can_do_its_service_s_work_and_no_more(urls: dict[str, str], room: Path) -> None:
    with pytest.raises(DatabaseError):
        open_store(urls["writer"])  # without a schema there is nothing to write to
    engine = make_engine(urls["owner"])
    schema.upgrade(engine)
    engine.dispose()
    made = {"detector": "recorded", "encoder": "gist", "features": "orb", "threads": 1}
    own = Settings(database_url=urls["writer"], **made)  # type: ignore[arg-type]
    [summary] = ingest_recordings([room], own, IngestOptions(keyframes=2, map_name="m"))
    assert summary.stored == 2
    with open_store(urls["writer"]) as store:
        store.delete_recording(summary.recording_id)
    for statement in (
        "CREATE TABLE t (a INT)",
        "DROP TABLE queries",
        "ALTER TABLE maps ADD a INT",
        "DROP DATABASE semdb",
    ):
        refused(urls["writer"], statement)
    for statement in ("INSERT INTO maps (name) VALUES ('x')", "UPDATE maps SET name = 'x'", "DELETE FROM maps"):
        refused(urls["reader"], statement)
    for role in ROLES:
        refused(urls[role], "SELECT * FROM mysql.global_priv")
        refused(urls[role], "SELECT 'x' INTO OUTFILE '/tmp/semdb-must-not-be-written'")
    engine = make_engine(urls["reader"])
    with engine.connect() as connection:
        assert connection.exec_driver_sql("SELECT name FROM maps").scalars().all() == ["m"]
        assert connection.exec_driver_sql("SELECT COUNT(*) FROM keyframe_objects").scalar() == 0
    engine.dispose()


def test_commands_of_the_services_are_commands() -> None:
    services = yaml.safe_load((REPOSITORY / "docker-compose.yml").read_text())["services"]
    program, *arguments = services["migrate"]["command"]
    assert program == "semdb"
    assert CliRunner().invoke(app, [*arguments, "--help"]).exit_code == 0
    assert CliRunner().invoke(app, ["no-such-command", "--help"]).exit_code == 2
    program, *arguments = services["worker"]["command"]
    assert program == "celery"
    from celery.bin.celery import celery

    assert arguments[:3] == ["--app", "semdb.workers", "worker"]
    assert celery_app.main == "semdb"
    options = {name for parameter in celery.commands["worker"].params for name in parameter.opts}
    assert {argument for argument in arguments[3:] if argument.startswith("--")} <= options
