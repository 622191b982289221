"""MySQL, in the folder that scripts/install-mysql.sh has filled, as the tests run it.

`SEMDB_TEST_MYSQL_URL` names a server to use instead (an account that may create schemas and accounts; the schema in
the URL is the prefix of those that the tests make). `SEMDB_TEST_MYSQL_PREFIX` is another folder.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from tests.servers import SETTINGS, START_TIMEOUT_S, ServerError


class MySQL:
    name = "mysql"
    variable = "SEMDB_TEST_MYSQL_URL"
    with_tls = ("--tls-version=TLSv1.2,TLSv1.3",)
    first_statement = "SET SESSION sql_log_bin = 0;\n"  # not for the other nodes of a group, which have their own

    def command(self) -> Sequence[str]:
        own = (
            "--mysqlx=OFF",
            "--secure-file-priv=NULL",
            "--tls-version=",  # as MariaDB without a certificate; tests of TLS bring one
            "--skip-log-bin",
            "--innodb-doublewrite=OFF",
            "--innodb-redo-log-capacity=32M",
        )
        return [str(_prefix() / "mysqld"), *SETTINGS, *own, *_as_root()]

    def user(self) -> str | None:
        """The one we are, also root: the folder of the server may be closed to others."""
        return None

    def make_data(self, folder: Path, options: Sequence[str]) -> None:
        if not options:
            shutil.copytree(_prefix() / "data", folder / "data", dirs_exist_ok=True)
            return
        made = subprocess.run(
            [
                _prefix() / "mysqld",
                "--initialize-insecure",
                f"--datadir={folder / 'data'}",
                f"--tmpdir={folder / 'tmp'}",
                *options,
                *_as_root(),
            ],
            capture_output=True,
            text=True,
            timeout=START_TIMEOUT_S,
            check=False,
        )
        if made.returncode != 0:
            raise ServerError(f"mysqld --initialize-insecure failed: {(made.stdout + made.stderr)[-500:]}")


MYSQL = MySQL()


def _prefix() -> Path:
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    prefix = Path(os.environ.get("SEMDB_TEST_MYSQL_PREFIX") or f"{cache}/semdb-tests/mysql")
    if not (prefix / "mysqld").exists():
        raise ServerError(
            f"no MySQL in {prefix}: scripts/install-mysql.sh fetches it; or set {MySQL.variable}="
            "mysql+pymysql://USER:PASSWORD@HOST/semdb_test"
        )
    return prefix


def _as_root() -> list[str]:
    return ["--user=root"] if os.geteuid() == 0 else []
