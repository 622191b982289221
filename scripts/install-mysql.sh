#!/usr/bin/env bash
# A MySQL server for the tests in a folder of its own, beside whatever is installed: scripts/install-mysql.sh [PREFIX]
#
# Its packages are those of the distribution: Ubuntu's own mysql-server-core, and on Debian, which has no MySQL in its
# stable releases, that of the suite unstable, from the archive that this machine's apt uses anyway. Nothing is installed
# and apt's own state is not touched: the packages are unpacked, C library included, and the server is started through
# the loader among them: PREFIX/mysqld does that, and PREFIX/data is an empty data directory. A second call finds them
# there and does nothing.
set -Eeuo pipefail # readers of a pipe read to its end: pipefail takes a writer that is cut off for a failure

prefix=${1:-${SEMDB_TEST_MYSQL_PREFIX:-${XDG_CACHE_HOME:-$HOME/.cache}/semdb-tests/mysql}}
oldest=8.0

give_up() {
  echo "no MySQL for the tests: $*" >&2
  exit 1
}

trap 'give_up "line $LINENO of $0 failed"' ERR

ready() { [ -d "$prefix/data" ] && "$prefix/mysqld" --version >/dev/null 2>&1; }

ready && exit 0
for program in apt-get apt-cache dpkg flock; do
  command -v "$program" >/dev/null || give_up "it is unpacked with $program, which is not here"
done
mkdir -p "$(dirname "$prefix")" 2>/dev/null || give_up "$prefix cannot be made"
exec 9>"$prefix.lock"
flock 9 # two checkouts, or two runs, share it
ready && exit 0

work=$(mktemp -d "$prefix.XXXXXX")
trap 'rm -rf "$work"' EXIT
mkdir -p "$work"/{apt/lists/partial,apt/cache/archives/partial,tree}
: >"$work/apt/status" # nothing counts as installed, so that all that the server needs is fetched
log="$work/log"
options=(
  -o Dir::State="$work/apt" -o Dir::State::Lists="$work/apt/lists" -o Dir::State::status="$work/apt/status"
  -o Dir::Cache="$work/apt/cache" -o APT::Sandbox::User= -o APT::Install-Recommends=false
  -o Acquire::Retries=3
)
. /etc/os-release
if [ "${ID:-}" = debian ]; then
  archive=$(apt-get indextargets --format '$(REPO_URI) $(SUITE)' 2>/dev/null | awk '$2 !~ /security|updates|backports/ {print $1}' | sed -n 1p)
  [ -n "$archive" ] || give_up "apt has no archive of Debian among its sources"
  keys=$(find /usr/share/keyrings -name 'debian-archive-keyring.[gp][gp][gp]' 2>/dev/null | sed -n 1p)
  echo "deb ${keys:+[signed-by=$keys] }$archive unstable main" >"$work/apt/sources.list"
  options+=(-o Dir::Etc::SourceList="$work/apt/sources.list" -o Dir::Etc::SourceParts=/dev/null)
  options+=(-o APT::Update::Error-Mode=any) # what cannot be fetched is an error, not a warning
fi

echo "fetching MySQL for the tests (60 MB) into $prefix"
apt-get "${options[@]}" update >"$log" 2>&1 || give_up "apt-get update failed: $(grep '^E:' "$log" | sed -n 1p)"
package=$(apt-cache "${options[@]}" search --names-only '^mysql-server-core(-[0-9.]+)?$' 2>/dev/null | cut -d' ' -f1 | sort -V | tail -n 1)
[ -n "$package" ] || give_up "the archive has no mysql-server-core for $(dpkg --print-architecture)"
version=$(apt-cache "${options[@]}" show "$package" | awk '$1 == "Version:" {print $2}' | sed -n 1p)
dpkg --compare-versions "$version" ge "$oldest" || give_up "the archive has MySQL $version, older than $oldest"
apt-get "${options[@]}" install --yes --download-only "$package" >"$log" 2>&1 ||
  give_up "$package could not be fetched: $(tail -n 1 "$log")"
for file in "$work"/apt/cache/archives/*.deb; do
  dpkg -x "$file" "$work/tree" 2>"$log" || give_up "$(basename "$file") could not be unpacked: $(tail -n 1 "$log")"
done

one() { # the one path below the tree that ends so, relative to it
  (cd "$work/tree" && find -L usr -path "$1" -print 2>/dev/null | sort | sed -n 1p)
}
server=$(one '*/sbin/mysqld')
loader=$(one 'usr/lib*/ld-linux*.so.[0-9]')
libraries=$(dirname "$(one '*/libc.so.6')")
plugins=$(dirname "$(one '*/plugin/group_replication.so')")
messages=$(dirname "$(one '*/english/errmsg.sys')")
charsets=$(one '*/mysql/charsets/Index.xml')
for found in "$server" "$loader" "$libraries" "$plugins" "$messages" "$charsets"; do
  [ -n "$found" ] && [ "$found" != . ] || give_up "MySQL $version lacks a file that the tests need"
done
cat >"$work/tree/mysqld" <<END
#!/bin/sh
# MySQL $version, with the libraries beside it; written by install-mysql.sh
here=\$(dirname "\$(readlink -f "\$0")")
exec "\$here/$loader" --library-path "\$here/$libraries:\$here/$(dirname "$plugins")/private" "\$here/$server" \\
  --no-defaults "--basedir=\$here/usr" "--lc-messages-dir=\$here/$(dirname "$messages")" \\
  "--character-sets-dir=\$here/$(dirname "$charsets")" "--plugin-dir=\$here/$plugins" "\$@"
END
chmod 755 "$work/tree" "$work/tree/mysqld"
# A new data directory takes seconds to make, and a moment to copy.
mkdir "$work/tree/data"
"$work/tree/mysqld" --initialize-insecure "--user=$(id -un)" "--datadir=$work/tree/data" --innodb-autoextend-increment=8 \
  --innodb-redo-log-capacity=32M --innodb-doublewrite=OFF >"$log" 2>&1 || give_up "MySQL $version does not start here: $(tail -n 1 "$log")"
rm "$work/tree/data/auto.cnf" # each server has a name of its own
if [ -e "$prefix" ] && ! rmdir "$prefix" 2>/dev/null; then
  grep -qs 'written by install-mysql.sh' "$prefix/mysqld" || give_up "$prefix holds something else"
  rm -rf "$prefix" # one that does not start any more
fi
mv "$work/tree" "$prefix"
echo "MySQL $version is in $prefix"
