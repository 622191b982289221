"""The OpenAPI document against what is answered, by requests that schemathesis makes up."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import semdb
from semdb.database.store import open_store
from semdb.service.settings import ServeSettings
from tests.database_samples import fill, stored_landmarks
from tests.serving import running

CHECKS = "not_a_server_error,status_code_conformance,content_type_conformance,response_schema_conformance"


@pytest.mark.long
@pytest.mark.parametrize("examples", [2, 60])
def test_no_request_is_answered_by_an_error_of_the_service(tmp_path: Path, examples: int) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite3'}"
    with open_store(url, create=True) as store:
        map_id, _, _ = fill(store)
        stored_landmarks(store, map_id)
    settings = ServeSettings(rate=0, uploads=tmp_path / "uploads", ingest_roots=str(tmp_path / "none"))
    with running(semdb.open(url, sql_time_limit_s=1.0, cache_dir=tmp_path), settings) as served:
        command = [
            *(sys.executable, "-c", "from schemathesis.cli import schemathesis; schemathesis()", "run"),
            *(f"{served.url}/v1/openapi.json", "--checks", CHECKS, "--max-examples", str(examples), "--seed", "1"),
            *("--phases", "examples,fuzzing", "--generation-database", "none", "--request-timeout", "30"),
            *("--exclude-path", "/ready", "--exclude-path-regex", "events$"),  # not ready: the samples' models
        ]
        done = subprocess.run(command, capture_output=True, text=True, timeout=1500, cwd=tmp_path, check=False)
        assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
