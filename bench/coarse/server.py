"""The private server of the benchmark of the coarse step."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests.mariadb import MARIADB
from tests.servers import TestServer, server

OPTIONS = (
    "--innodb-buffer-pool-size=2G",  # the rows of a million keyframes without their vectors
    "--innodb-log-file-size=1G",
    "--innodb-doublewrite=0",
    "--innodb-io-capacity=5000",
    "--innodb-io-capacity-max=20000",
    "--local-infile=1",
)


@contextlib.contextmanager
def bench_server(keep: Path | None) -> Iterator[TestServer]:
    """A MariaDB on loopback whose data stay in `keep`, or go with it."""
    with contextlib.ExitStack() as stack:
        folder = keep or Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="semdb-coarse-")))
        yield stack.enter_context(server(MARIADB, *OPTIONS, keep=folder.resolve()))
