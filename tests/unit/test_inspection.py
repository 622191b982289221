"""What `semdb doctor` makes of a server."""

from __future__ import annotations

import dataclasses

import pytest

from semdb.database.inspection import ServerFacts, judge

GOOD = ServerFacts(
    version="10.11.19-MariaDB-0+deb12u1",
    variables={
        "max_allowed_packet": str(16 * 2**20),
        "tx_isolation": "REPEATABLE-READ",
        "character_set_connection": "utf8mb4",
        "innodb_buffer_pool_size": str(2**30),
        "read_only": "OFF",
        "wsrep_on": "OFF",
    },
    collation="utf8mb4_bin",
    cipher="TLS_AES_256_GCM_SHA384",
    local=False,
    cluster_size=0,
)


def problems(**changed: object) -> dict[str, str]:
    variables = {**GOOD.variables, **changed.pop("variables", {})}  # type: ignore[dict-item]
    facts = dataclasses.replace(GOOD, variables=variables, **changed)  # type: ignore[arg-type]
    return {finding.what: finding.text for finding in judge(facts) if finding.state == "problem"}


def test_a_server_that_is_right() -> None:
    assert problems() == {}
    assert {finding.state for finding in judge(GOOD)} == {"ok"}


def test_each_problem_says_what_to_change() -> None:
    assert "older than 10.11" in problems(version="10.5.1-MariaDB")["version"]
    assert problems(version="8.4.2") == {}
    assert "older than 8.0" in problems(version="5.7.44")["version"]
    assert "SET GLOBAL max_allowed_packet" in problems(variables={"max_allowed_packet": "1048576"})["packet size"]
    assert "REPEATABLE-READ" in problems(variables={"tx_isolation": "READ-UNCOMMITTED"})["isolation"]
    assert "ALTER DATABASE" in problems(collation="latin1_swedish_ci")["character set"]
    assert "ssl_mode=REQUIRED" in problems(cipher="")["TLS"]
    assert problems(cipher="", local=True) == {}
    assert "read_only" in problems(variables={"read_only": "ON"})


def test_the_prefix_of_old_protocols_is_not_the_version() -> None:
    assert dataclasses.replace(GOOD, version="5.5.5-10.11.2-MariaDB-log").numbers == (10, 11)


def test_a_small_cluster_is_named() -> None:
    two = dataclasses.replace(GOOD, cluster_size=2)
    assert [finding.state for finding in judge(two) if finding.what == "cluster"] == ["info"]


@pytest.mark.parametrize(
    ("members", "state", "said"), [(3, "ok", "group replication, 3 nodes"), (0, "info", "GRANT SELECT ON")]
)
def test_a_group_of_mysql_is_named(members: int, state: str, said: str) -> None:
    variables = {**GOOD.variables, "group_replication_group_name": "0000-0000"}
    facts = dataclasses.replace(GOOD, cluster_size=members, variables=variables)
    [finding] = [finding for finding in judge(facts) if finding.what == "cluster"]
    assert finding.state == state
    assert said in finding.text
