#!/usr/bin/env bash
# The servers that the tests run on loopback: MariaDB with Galera, Redis and nginx from the distribution, and a MySQL in a
# folder of its own (install-mysql.sh); zsh, to press TAB in it; node, to build the page of the service, and Chromium to look
# at it. Tests on other servers name them in SEMDB_TEST_MARIADB_URL and SEMDB_TEST_MYSQL_URL; those that kill servers, and those
# of a cluster, need them here.
set -euo pipefail
PATH=$PATH:/usr/sbin:/usr/local/sbin
here=$(dirname "$0")

packages=()
command -v mariadbd >/dev/null || packages+=(mariadb-server)
[ -e /usr/lib/galera/libgalera_smm.so ] || packages+=(galera-4)
command -v rsync >/dev/null || packages+=(rsync)
command -v redis-server >/dev/null || packages+=(redis-server)
command -v zsh >/dev/null || packages+=(zsh)
command -v nginx >/dev/null || packages+=(nginx-light)

if [ ${#packages[@]} -gt 0 ] && ! "$here/apt-install.sh" "${packages[@]}"; then
  if command -v mariadbd >/dev/null || [ -n "${SEMDB_TEST_MARIADB_URL:-}" ]; then
    echo "not installed: ${packages[*]}; the tests that need them fail or are skipped, and say so" >&2
  else
    echo "the tests need MariaDB: install it, or set SEMDB_TEST_MARIADB_URL to a server and an account for tests" >&2
    exit 1
  fi
fi

# each for itself: a distribution that has no such package has servers all the same
for_page() {
  "$here/apt-install.sh" "$@" || echo "not installed: $*; the tests of the page that need it are skipped, and say so" >&2
}
[ -n "${SEMDB_TEST_CHROMIUM:-}" ] || command -v chromium chromium-browser google-chrome >/dev/null || for_page chromium
{ command -v node && command -v npm; } >/dev/null || for_page nodejs npm

if ! "$here/install-mysql.sh" && [ "${SEMDB_TEST_REQUIRE_MYSQL:-0}" != 0 ]; then
  exit 1
fi
