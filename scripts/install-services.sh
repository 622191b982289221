#!/usr/bin/env bash
# The servers that the tests run on loopback. A test run on another server names it in SEMDB_TEST_MYSQL_URL.
set -euo pipefail
PATH=$PATH:/usr/sbin:/usr/local/sbin

if ! command -v mariadbd >/dev/null; then
  if [ -n "${SEMDB_TEST_MYSQL_URL:-}" ]; then
    echo "no MariaDB here: the tests use the server of SEMDB_TEST_MYSQL_URL"
  elif ! "$(dirname "$0")/apt-install.sh" mariadb-server; then
    echo "the tests need MariaDB: install it, or set SEMDB_TEST_MYSQL_URL to a server and an account for tests" >&2
    exit 1
  fi
fi
