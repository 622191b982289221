"""Compiled kernels are pickles: where another user may write them they are not read, as ssh does with its keys."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from semdb import compiled
from semdb.rights import file_problem, folder_problem

NOBODY = 65534
root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can give files to another user")


@pytest.fixture
def mine(tmp_path: Path) -> Iterator[Path]:
    """A folder that nobody else can write, whatever the mask of this process."""
    tmp_path.chmod(0o755)
    folder = tmp_path / "mine"
    folder.mkdir()
    folder.chmod(0o755)
    yield folder
    folder.chmod(0o755)


def test_a_folder_of_ones_own_is_trusted(mine: Path) -> None:
    assert folder_problem(mine) is None
    (mine / "inner").mkdir(mode=0o700)
    assert folder_problem(mine / "inner") is None


@pytest.mark.parametrize("mode", [0o777, 0o757, 0o1777, 0o733])
def test_a_folder_that_others_may_write_is_not(mine: Path, mode: int) -> None:
    mine.chmod(mode)
    problem = folder_problem(mine)
    assert problem == f"{mine} may be written by others (mode {mode:04o})"


def test_above_it_sticky_folders_may_be_open_and_no_others(mine: Path) -> None:
    inner = mine / "inner"
    inner.mkdir(mode=0o755)
    mine.chmod(0o1777)
    assert folder_problem(inner) is None
    mine.chmod(0o777)
    assert folder_problem(inner) == f"{mine} may be written by others (mode 0777)"


def test_links_are_checked_on_both_sides(mine: Path) -> None:
    (mine / "open").mkdir()
    (mine / "real").mkdir(mode=0o755)
    (mine / "open" / "link").symlink_to(mine / "real")
    (mine / "open").chmod(0o777)  # somebody may put another link there
    assert folder_problem(mine / "open" / "link") == f"{mine / 'open'} may be written by others (mode 0777)"
    (mine / "link").symlink_to(mine / "open")
    assert folder_problem(mine / "link") == f"{mine / 'link'} may be written by others (mode 0777)"


@root
def test_folders_and_files_of_others_are_not_trusted(mine: Path) -> None:
    file = mine / "a.nbi"
    file.touch()
    file.chmod(0o644)
    assert file_problem(file) is None
    os.chown(file, NOBODY, -1)
    assert file_problem(file) == f"{file} belongs to user nobody"
    assert file_problem(file, owners=(NOBODY,)) is None
    os.chown(mine, NOBODY, -1)
    assert folder_problem(mine) == f"{mine} belongs to user nobody"
    assert folder_problem(mine, owners=(NOBODY,)) is None
    os.chown(mine, 123456, -1)
    assert folder_problem(mine) == f"{mine} belongs to user 123456"


@root
def test_groups_with_other_members_are_others(mine: Path) -> None:
    os.chown(mine, -1, NOBODY)
    mine.chmod(0o775)
    assert folder_problem(mine) == f"{mine} may be written by others (mode 0775)"
    os.chown(mine, -1, 0)  # root's own
    assert folder_problem(mine) is None


def test_files_that_others_may_write_or_that_are_none(mine: Path) -> None:
    (mine / "a.nbi").touch()
    (mine / "a.nbi").chmod(0o666)
    assert file_problem(mine / "a.nbi") == f"{mine / 'a.nbi'} may be written by others (mode 0666)"
    (mine / "b.nbi").symlink_to(mine / "a.nbi")
    assert file_problem(mine / "b.nbi") == f"{mine / 'b.nbi'} is no regular file"
    assert file_problem(mine / "gone.nbi") is None


PROGRAM = """
from semdb.compiled import kernel
@kernel
def double(x):
    return 2 * x
print(double(21))
"""


def run(folder: Path, cache: Path, home: Path) -> tuple[str, str]:
    """What a program with a kernel prints, in a process of its own with `cache` as NUMBA_CACHE_DIR."""
    (folder / "program.py").write_text(PROGRAM)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cache), "HOME": str(home), "XDG_CACHE_HOME": str(home / "cache")}
    done = subprocess.run(
        [sys.executable, str(folder / "program.py")], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout, done.stderr


class _Evil:
    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.system, (f"touch {self.marker}",)


def poison(cache: Path, marker: Path) -> int:
    """Puts code into every compiled kernel below `cache`."""
    files = [*cache.rglob("*.nbi"), *cache.rglob("*.nbc")]
    for file in files:
        file.write_bytes(pickle.dumps(_Evil(marker)))
    return len(files)


@pytest.mark.parametrize("how", ["folder", "file"])
def test_code_in_a_cache_that_others_may_write_is_not_run(mine: Path, how: str) -> None:
    cache, home, marker = mine / "shared" / "cache", mine / "home", mine / "marker"
    home.mkdir(mode=0o755)
    cache.mkdir(parents=True, mode=0o755)
    assert run(mine, cache, home) == ("42\n", "")
    assert poison(cache, marker) >= 2
    if how == "folder":
        cache.chmod(0o777)
    else:
        next(cache.rglob("*.nbi")).chmod(0o666)
    out, err = run(mine, cache, home)
    assert out == "42\n"
    assert not marker.exists()
    assert "compiled kernels are not read from a cache that others may have written" in err
    assert "may be written by others" in err
    if how == "file":
        return
    cache.chmod(0o755)  # a test of this test: where the cache is trusted, the code in it is run
    run_anyway = subprocess.run(
        [sys.executable, str(mine / "program.py")],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert marker.exists(), run_anyway.stderr


def test_a_folder_that_is_made_is_ones_own(mine: Path) -> None:
    cache = mine / "new"
    previous = os.umask(0o022)
    try:
        assert [run(mine, cache, mine) for _ in range(2)] == [("42\n", "")] * 2
    finally:
        os.umask(previous)
    assert oct(cache.stat().st_mode & 0o777) == "0o700"


def test_a_cache_beside_the_source_is_as_safe_as_the_source(mine: Path) -> None:
    (mine / "module.py").touch()
    (mine / "__pycache__").mkdir()
    (mine / "__pycache__").chmod(0o777)
    compiled.cache_problem.cache_clear()
    assert compiled.cache_problem(mine / "__pycache__", mine / "module.py") is not None
    mine.chmod(0o777)  # whoever may exchange the cache may exchange the source
    compiled.cache_problem.cache_clear()
    assert compiled.cache_problem(mine / "__pycache__", mine / "module.py") is None
    (mine / "elsewhere").mkdir()
    assert compiled.cache_problem(mine / "elsewhere", mine / "module.py") is not None
