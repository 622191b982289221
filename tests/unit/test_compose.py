"""docker-compose.yml: against the compose specification's schema, then what the schema cannot say."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml

from semdb.database.accounts import RIGHTS, plan_accounts

REPOSITORY = Path(__file__).resolve().parents[2]
COMPOSE = REPOSITORY / "docker-compose.yml"
CONDITIONS = {"service_healthy", "service_completed_successfully"}


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load(COMPOSE.read_text())
    return loaded


def validate(file: Path) -> subprocess.CompletedProcess[str]:
    """Check a file against the compose specification's JSON schema, which travels with check-jsonschema."""
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", str(file)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_it_is_valid_against_the_compose_specification() -> None:
    result = validate(COMPOSE)
    assert result.returncode == 0, result.stdout + result.stderr


def test_the_specification_finds_a_misspelled_key(tmp_path: Path) -> None:
    broken = tmp_path / "docker-compose.yml"
    broken.write_text(COMPOSE.read_text().replace("healthcheck:", "healthchek:", 1))
    result = validate(broken)
    assert result.returncode == 1
    assert "healthchek" in result.stdout


def test_services_and_images(compose: dict[str, Any]) -> None:
    services = compose["services"]
    assert set(services) == {"database", "migrate", "broker", "worker", "service"}
    assert services["database"]["image"] == "mysql:9.7"
    assert services["migrate"]["command"] == ["semdb", "init"]
    assert services["migrate"]["restart"] == "no"  # one shot
    assert services["worker"]["command"][:3] == ["celery", "--app", "semdb.workers"]


def test_dependencies_exist_and_can_be_met(compose: dict[str, Any]) -> None:
    services = compose["services"]
    for name, service in services.items():
        for other, how in service.get("depends_on", {}).items():
            assert other in services, f"{name} depends on {other}, which is not there"
            assert how["condition"] in CONDITIONS
            if how["condition"] == "service_healthy":
                assert "healthcheck" in services[other], f"{other} has no health check"
            else:
                assert services[other]["restart"] == "no"
    assert services["worker"]["depends_on"]["migrate"]["condition"] == "service_completed_successfully"
    assert all("healthcheck" in services[name] for name in ("database", "broker", "worker", "service"))


def test_named_volumes_are_declared(compose: dict[str, Any]) -> None:
    used = set()
    for service in compose["services"].values():
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            if re.fullmatch(r"[a-z]+", source):
                used.add(source)
    assert used == set(compose["volumes"])


def test_no_password_is_in_the_file_and_every_one_is_required(compose: dict[str, Any]) -> None:
    secrets = 0
    for service in compose["services"].values():
        for variable, value in service.get("environment", {}).items():
            if "PASSWORD" in variable:
                assert re.fullmatch(r"\$\{[A-Z_]+:\?[^}]+\}", value), f"{variable} has a value in the file"
                secrets += 1
            match = re.match(r"[a-z+]+://[^:/]*:(.*)@", str(value))
            if match:
                assert re.fullmatch(r"\$\{[A-Z_]+:\?[^}]+\}", match[1]), f"{variable} has a password in the file"
                secrets += 1
    # root, owner, writer, reader; the broker's; and in the URLs of migrate (one), worker and service (three each)
    assert secrets == 12
    assert re.fullmatch(r"\$\{[A-Z_]+:\?[^}]+\}", compose["services"]["service"]["environment"]["SEMDB_SERVE_SECRET"])


def test_each_service_has_the_account_that_it_needs(compose: dict[str, Any]) -> None:
    services = compose["services"]
    assert "://semdb_owner:" in services["migrate"]["environment"]["SEMDB_DATABASE_URL"]
    for name in ("worker", "service"):
        given = services[name]["environment"]
        assert "://semdb_writer:" in given["SEMDB_DATABASE_URL"]
        assert "://semdb_reader:" in given["SEMDB_READER_URL"]
        assert all("ssl_mode=REQUIRED" in given[url] for url in ("SEMDB_DATABASE_URL", "SEMDB_READER_URL"))
    # passwords on a command line are in the list of processes
    for service in services.values():
        for part in (*service.get("command", []), *service.get("healthcheck", {}).get("test", [])):
            assert "--password" not in part
            assert "${" not in part
            assert not re.search(r" -p\S", part)


def test_the_script_of_the_accounts_grants_what_semdb_does(tmp_path: Path) -> None:
    client = tmp_path / "mysql"
    client.write_text('#!/bin/sh\necho "$@" > "$OUT/arguments"\ncat > "$OUT/statements"\n')
    client.chmod(0o755)
    given = {f"SEMDB_{role.upper()}_PASSWORD": f"word{role}1" for role in RIGHTS}
    environment = {
        "PATH": f"{tmp_path}:{os.environ['PATH']}",
        "OUT": str(tmp_path),
        "MYSQL_ROOT_PASSWORD": "r",
        **given,
    }
    script = REPOSITORY / "scripts" / "compose-accounts.sh"
    subprocess.run(["bash", str(script)], env=environment, check=True, timeout=30)
    statements = (tmp_path / "statements").read_text()
    for role, rights in RIGHTS.items():
        assert f"CREATE USER 'semdb_{role}'@'%' IDENTIFIED BY 'word{role}1';" in statements
        assert (f"GRANT {rights} ON semdb.* TO 'semdb_{role}'@'%';" in statements) == (role != "reader")
    plan = plan_accounts("mysql+pymysql://root@127.0.0.1/semdb", roles=("reader",))
    for statement in plan.statements[1:]:
        assert f"{statement};" in statements.splitlines()
    assert "word" not in (tmp_path / "arguments").read_text()
    refused = subprocess.run(
        ["bash", str(script)],
        env={**environment, "SEMDB_READER_PASSWORD": "it's"},
        capture_output=True,
        text=True,
        check=False,
        timeout=30,
    )
    assert refused.returncode != 0
    assert "letters and digits" in refused.stderr


def test_the_service_is_reached_on_loopback_and_workers_see_its_uploads(compose: dict[str, Any]) -> None:
    service, worker = compose["services"]["service"], compose["services"]["worker"]
    assert [port.split(":")[0] for port in service["ports"]] == ["127.0.0.1"]
    assert "uploads:/uploads" in service["volumes"]
    assert "uploads:/uploads:ro" in worker["volumes"]
    assert service["environment"]["SEMDB_SERVE_UPLOADS"] == "/uploads"
    assert service["environment"]["SEMDB_RECORDING_ROOTS"].endswith("/recordings:/uploads}")


def test_settings_that_services_get_exist(compose: dict[str, Any]) -> None:
    from semdb.service.settings import ServeSettings
    from semdb.settings import Settings

    known = {f"SEMDB_{name.upper()}" for name in Settings.model_fields}
    known |= {f"SEMDB_SERVE_{name.upper()}" for name in ServeSettings.model_fields}
    for name in ("migrate", "worker", "service"):
        assert set(compose["services"][name]["environment"]) <= known
    for name in ("database", "broker"):
        assert not set(compose["services"][name]["environment"]) & known


def test_the_dockerfile_copies_what_is_there_and_not_ignored() -> None:
    allowed = {line[1:] for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    copied = set()
    for line in (REPOSITORY / "Dockerfile").read_text().splitlines():
        if line.startswith("COPY ") and "--from" not in line:
            copied.update(line.split()[1:-1])
    assert copied == allowed
    for name in copied:
        assert (REPOSITORY / name).exists(), f"Dockerfile copies {name}, which is not there"


def docker_compose(*arguments: str) -> subprocess.CompletedProcess[str]:
    names = ("DB_ROOT", "OWNER", "WRITER", "READER", "BROKER")
    environment = {**{f"SEMDB_{name}_PASSWORD": "a" for name in names}, "PATH": os.environ["PATH"]}
    environment["SEMDB_SERVE_SECRET"] = 32 * "a"
    command = ["docker", "compose", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, timeout=60)


def test_docker_reads_it() -> None:
    if shutil.which("docker") is None or docker_compose("version").returncode:
        pytest.skip("no docker compose here; the schema of the specification is checked above")
    result = docker_compose("--file", str(COMPOSE), "config", "--quiet")
    assert result.returncode == 0, result.stderr
