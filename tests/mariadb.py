"""MariaDB, from the distribution, as the tests run it.

`SEMDB_TEST_MARIADB_URL` names a server to use instead (an account that may create schemas and accounts; the schema in
the URL is the prefix of those that the tests make).
"""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from tests.servers import SETTINGS, START_TIMEOUT_S, ServerError


class MariaDB:
    name = "mariadb"
    variable = "SEMDB_TEST_MARIADB_URL"
    with_tls = ()
    first_statement = ""

    def command(self) -> Sequence[str]:
        own = ("--sync-frm=0", "--innodb-log-file-size=16M")
        return [_program("mariadbd"), "--no-defaults", *SETTINGS, *own]

    def user(self) -> str | None:
        """Not root."""
        if os.geteuid() != 0:
            return None
        try:
            return pwd.getpwnam("mysql").pw_name
        except KeyError as error:
            raise ServerError("there is no user mysql on this machine: install mariadb-server") from error

    def make_data(self, folder: Path, options: Sequence[str]) -> None:
        user = self.user()
        made = subprocess.run(
            [
                _program("mariadb-install-db"),
                "--no-defaults",
                f"--datadir={folder / 'data'}",
                f"--tmpdir={folder / 'tmp'}",
                "--skip-test-db",
                *options,
                *([f"--user={user}"] if user else []),
            ],
            capture_output=True,
            text=True,
            timeout=START_TIMEOUT_S,
            check=False,
        )
        if made.returncode != 0:
            raise ServerError(f"mariadb-install-db failed: {(made.stdout + made.stderr)[-500:]}")


MARIADB = MariaDB()


def _program(name: str) -> str:
    found = shutil.which(name, path=os.environ.get("PATH", "") + ":/usr/sbin:/usr/local/sbin")
    if found is None:
        raise ServerError(
            f"no {name} here: scripts/install-services.sh installs it; or set {MariaDB.variable}="
            "mysql+pymysql://USER:PASSWORD@HOST/semdb_test"
        )
    return found
