"""`import semdb` is instant: what takes long is imported when it is asked for."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

import semdb

HEAVY = ("numpy", "sqlalchemy", "pydantic", "cv2", "numba", "scipy", "onnxruntime", "torch", "typer", "semdb.api")


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    return done


def test_import_brings_nothing_heavy() -> None:
    loaded = json.loads(python("-c", "import semdb, sys, json; print(json.dumps(sorted(sys.modules)))").stdout)
    assert [name for name in HEAVY if name in loaded] == []
    own = [name for name in loaded if name.startswith("semdb") and not name.startswith("semdb.__")]
    assert own == ["semdb"]


def test_import_takes_less_than_a_tenth_of_a_second() -> None:
    """The best of three, of other work on the machine."""
    micros = []
    for _ in range(3):
        report = python("-X", "importtime", "-c", "import semdb").stderr
        [line] = [line for line in report.splitlines() if re.search(r"\| semdb$", line)]
        micros.append(int(line.split("|")[1]))
    assert min(micros) < 100_000


def test_the_door_brings_no_network_and_no_compiler() -> None:
    """What commands that only read rows go through."""
    loaded = json.loads(python("-c", "import semdb.api, sys, json; print(json.dumps(sorted(sys.modules)))").stdout)
    assert [name for name in ("cv2", "numba", "scipy", "onnxruntime", "torch", "matplotlib") if name in loaded] == []


def test_all_names_are_there() -> None:
    for name in semdb.__all__:
        assert getattr(semdb, name) is not None
    assert set(semdb.__all__) <= set(dir(semdb))
    with pytest.raises(AttributeError, match="no attribute 'opne'"):
        _ = semdb.opne


def test_every_lazy_name_is_public() -> None:
    assert set(semdb._LAZY) | {"open", "connect", "connect_async"} == set(semdb.__all__)
