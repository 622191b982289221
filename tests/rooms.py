"""A small rendered room for tests, and commands run as a person would."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from semdb.recordings.synthetic import SyntheticOptions, write_synthetic_recording
from tests import preloaded

SMALL = SyntheticOptions(frames=24, width=320, height=240, lap_frames=80)
COMMAND = [sys.executable, "-m", "semdb.cli.main"]
TIMEOUT_S = 300


def render(directory: Path, options: SyntheticOptions = SMALL) -> Path:
    write_synthetic_recording(directory, options)
    return directory


def environment(database_url: str, **settings: str) -> dict[str, str]:
    """The environment of a command: nothing of SEMDB_ but what is given."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("SEMDB_")}
    return {
        **kept,
        "SEMDB_DATABASE_URL": database_url,
        "SEMDB_THREADS": "1",
        "SEMDB_CHECK_RECORDINGS": "false",  # a second for each ingest; tests of the check say otherwise
        **settings,
    }


def semdb(*arguments: object, url: str, cwd: Path | None = None, **settings: str) -> subprocess.CompletedProcess[str]:
    """Runs ``semdb ARGUMENTS`` in a process of its own."""
    words, variables = [*map(str, arguments)], environment(url, **settings)
    if all(name.startswith("SEMDB_") for name in settings):
        return preloaded.run(words, variables, cwd, TIMEOUT_S)
    return subprocess.run(  # what is no setting of semdb may be one of Python
        [*COMMAND, *words], env=variables, cwd=cwd, capture_output=True, text=True, timeout=TIMEOUT_S, check=False
    )


def semdb_json(*arguments: object, url: str, **settings: str) -> Any:
    """What a command prints as JSON; fails with its stderr when it fails."""
    done = semdb(*arguments, url=url, **settings)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
