#!/usr/bin/env bash
# Run once by the image mysql, when its data directory is made: the schema, and three accounts with the least rights
# that do (docs/database.md). Passwords come from the environment and go to the client on its standard input.
# No `exit` and no `set -u`: the image may read this file into its own shell.
semdb_password() {
  case "$1" in
    "" | *[!A-Za-z0-9]*) echo "passwords of semdb's accounts are letters and digits" >&2 && return 1 ;;
  esac
}

if semdb_password "$SEMDB_OWNER_PASSWORD" && semdb_password "$SEMDB_WRITER_PASSWORD" &&
  semdb_password "$SEMDB_READER_PASSWORD"; then
  MYSQL_PWD=$MYSQL_ROOT_PASSWORD mysql --protocol=socket --user=root <<SQL
CREATE DATABASE IF NOT EXISTS semdb CHARACTER SET utf8mb4 COLLATE utf8mb4_bin;
CREATE USER 'semdb_owner'@'%' IDENTIFIED BY '$SEMDB_OWNER_PASSWORD';
GRANT SELECT, INSERT, UPDATE, DELETE, CREATE, ALTER, DROP, INDEX, REFERENCES, CREATE VIEW, SHOW VIEW ON semdb.* TO 'semdb_owner'@'%';
CREATE USER 'semdb_writer'@'%' IDENTIFIED BY '$SEMDB_WRITER_PASSWORD';
GRANT SELECT, INSERT, UPDATE, DELETE ON semdb.* TO 'semdb_writer'@'%';
CREATE USER 'semdb_reader'@'%' IDENTIFIED BY '$SEMDB_READER_PASSWORD';
GRANT SELECT, SHOW VIEW ON semdb.* TO 'semdb_reader'@'%';
SQL
else
  false
fi
