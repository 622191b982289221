"""Servers that are set up otherwise than theirs came: modes, time zones, character sets, small packets, no writes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text

from semdb.database import refinements, schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store
from semdb.errors import DatabaseError
from tests import servers
from tests.database_samples import CATEGORIES, MODELS, fill, plan
from tests.integration.comparison import content
from tests.servers import TestServer, connect

MAP, RECORDING = "Küche 厨房 🍳", 'a\'b\\c "%s" `'
# Names of modes that only one of the servers knows are left out on the other.
MODES = {
    "ansi": "ANSI_QUOTES,PIPES_AS_CONCAT,IGNORE_SPACE,REAL_AS_FLOAT,ONLY_FULL_GROUP_BY",
    "no backslash": "NO_BACKSLASH_ESCAPES,STRICT_ALL_TABLES",
    "lax": "",
    "traditional": "TRADITIONAL,PAD_CHAR_TO_FULL_LENGTH,"
    "NO_UNSIGNED_SUBTRACTION,NO_AUTO_VALUE_ON_ZERO,HIGH_NOT_PRECEDENCE",
    "oracle": "ORACLE,EMPTY_STRING_IS_NULL,SIMULTANEOUS_ASSIGNMENT,TIME_ROUND_FRACTIONAL,TIME_TRUNCATE_FRACTIONAL",
}
# Variables that a session takes from the server when it begins.
VARIABLES = {
    "autocommit": "0",
    "character_set_server": "latin1",
    "collation_server": "latin1_swedish_ci",
    "completion_type": "2",
    "default_storage_engine": "MyISAM",
    "foreign_key_checks": "0",
    "group_concat_max_len": "8",
    "max_allowed_packet": "65536",
    "max_join_size": "20",
    "sql_auto_is_null": "1",
    "sql_quote_show_create": "0",
    "sql_safe_updates": "1",
    "sql_select_limit": "1",
    "time_zone": "'+09:30'",
    "transaction_isolation": "SERIALIZABLE",
    "unique_checks": "0",
    "wait_timeout": "5",
}


PRIMARY_KEYS = {"mariadb": "innodb-force-primary-key", "mysql": "sql-require-primary-key"}
OWN_MODES = {
    "mariadb": {"ORACLE", "EMPTY_STRING_IS_NULL", "SIMULTANEOUS_ASSIGNMENT", "TIME_ROUND_FRACTIONAL"},
    "mysql": {"TIME_TRUNCATE_FRACTIONAL"},
}


@pytest.fixture(scope="module")
def odd_server(server_kind: servers.Kind) -> Iterator[TestServer]:
    names, keys = "--lower-case-table-names=1", f"--{PRIMARY_KEYS[server_kind.name]}=ON"
    with servers.server(server_kind, names, keys, install_options=(names,)) as started:
        yield started


@contextlib.contextmanager
def changed(server: TestServer, **variables: str) -> Iterator[None]:
    """Sets global variables of a server for a while."""
    if server.kind == "mariadb":  # it has older names for some
        variables = {name.replace("transaction_", "tx_"): value for name, value in variables.items()}
    with contextlib.closing(connect(server.admin)) as connection, connection.cursor() as cursor:
        cursor.execute("SELECT " + ", ".join(f"@@GLOBAL.{name}" for name in variables))
        before = dict(zip(variables, cursor.fetchone(), strict=True))
    try:
        server.execute(*(f"SET GLOBAL {name} = {value}" for name, value in variables.items()))
        yield
    finally:
        for name, value in before.items():
            server.execute(f"SET GLOBAL {name} = {value!r}")


def exercise(url: str) -> dict[str, Any]:
    """What a database answers after an ingest, a look at it from every side, and a deletion."""
    engine = make_engine(url)
    schema.upgrade(engine)
    engine.dispose()
    with open_store(url) as store:
        map_id, _, ids = fill(store, MAP, RECORDING)
        kept = store.ensure_map("kept")
        store.plan_recording(kept, plan("long", range(6000)), MODELS)
        known = store.map_categories(map_id)
        found = {
            "content": content(store),
            "maps": [(info.name, info.keyframes) for info in store.maps()],
            "state": store.map_state(map_id).split()[0],
            "filter": store.class_filter(map_id, store.class_query(map_id, dict.fromkeys(CATEGORIES, 2.0)), 0.0),
            "categories": [name for _, name in known],
            "columns": [_columns(store, map_id, key) for key, _ in known],
            "vectors": store.load_vectors(ids).tobytes(),
            "confusions": _refined(store, map_id, [name for _, name in known]),
        }
        before = store.status()[0]
        found["status"] = (before.name, before.map, before.items, before.objects, before.keypoints, before.image_bytes)
        with store.engine.connect() as connection:
            now = "datetime('now')" if connection.dialect.name == "sqlite" else "UTC_TIMESTAMP()"
            late = connection.execute(text(f"SELECT COUNT(*) FROM recordings WHERE created_at > {now}")).scalar()
        found["made in the future"] = late
        store.delete_map(map_id)
        found["left"] = content(store)["counts"]
    return found


def _columns(store: Store, map_id: int, category_id: int) -> list[Any]:
    ids, parts = store.category_columns(map_id, category_id)
    return [len(ids), bool((np.diff(ids) > 0).all()), {str(part): numbers.tolist() for part, numbers in parts.items()}]


def _refined(store: Store, map_id: int, names: list[str]) -> list[Any]:
    from semdb.database.records import ClassConfusion

    made = [ClassConfusion(one, other, 3, 7) for one in names for other in names if one != other]
    state = store.map_state(map_id)
    store.replace_refinement(map_id, "classes", state, {"a": 1.5}, refinements.replace_confusions, made)
    [item] = store.refinements(map_id)
    assert item.current
    return [item.rows, store.class_confusions(map_id)]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return exercise(f"sqlite:///{tmp_path_factory.mktemp('modes') / 'a.sqlite3'}")


@pytest.mark.parametrize("mode", MODES)
def test_modes_change_nothing(odd_server: TestServer, expected: dict[str, Any], mode: str) -> None:
    foreign = set().union(*(modes for kind, modes in OWN_MODES.items() if kind != odd_server.kind))
    known = ",".join(name for name in MODES[mode].split(",") if name not in foreign)
    with changed(odd_server, sql_mode=f"'{known}'"), odd_server.schema() as url:
        assert exercise(url) == expected


def test_other_settings_change_nothing(odd_server: TestServer, expected: dict[str, Any]) -> None:
    with changed(odd_server, **VARIABLES), odd_server.schema() as url:
        assert exercise(url) == expected


@pytest.mark.parametrize("variable", ["read_only", "transaction_read_only"])
def test_a_server_that_takes_no_writes_says_so_and_is_read(odd_server: TestServer, variable: str) -> None:
    with odd_server.schema() as url:
        engine = make_engine(url)
        schema.upgrade(engine)
        engine.dispose()
        with open_store(url) as store:
            fill(store)
        odd_server.execute("DROP USER IF EXISTS replica@'127.0.0.1'")
        odd_server.execute("CREATE USER replica@'127.0.0.1' IDENTIFIED BY 'x'")
        odd_server.execute("GRANT SELECT, INSERT, UPDATE, DELETE ON *.* TO replica@'127.0.0.1'")
        account = odd_server.admin.set(username="replica", password="x", database=url.rpartition("/")[2])
        with (
            changed(odd_server, **{variable: "1"}),
            open_store(account.render_as_string(hide_password=False)) as store,
        ):
            assert store.status()[0].keyframes == 5
            with pytest.raises(DatabaseError, match="takes no writes: give SEMDB_DATABASE_URL the server that does"):
                store.ensure_map("another")
