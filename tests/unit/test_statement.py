"""What is told of a statement before a server sees it."""

from __future__ import annotations

import pytest

from semdb.database.statement import check_limits, check_reads
from semdb.errors import UsageError


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT * FROM maps FOR UPDATE",
        "select * from maps for\n\tshare",
        "SELECT * FROM maps FOR/**/SHARE OF maps NOWAIT",
        "SELECT * FROM maps FOR -- x\n UPDATE SKIP LOCKED",
        "SELECT * FROM maps FOR # x\n UPDATE",
        "SELECT * FROM maps LOCK IN SHARE MODE",
        "SELECT * FROM maps lock /* a */ in /* b */ share mode",
        "(SELECT * FROM maps FOR SHARE) UNION SELECT 1, 2, 3",
        "SELECT * FROM (SELECT * FROM maps FOR UPDATE) a",
        "WITH a AS (SELECT * FROM maps LOCK IN SHARE MODE) SELECT * FROM a",
        "SELECT 'a\\'' FROM maps FOR UPDATE -- '",
        "SELECT 'it''s' FROM maps FOR UPDATE -- '",
        'SELECT "a\\"" FROM maps FOR UPDATE -- "',
        "SELECT `a``b` FROM maps FOR UPDATE -- `",
        "SELECT 1--1 FROM maps FOR UPDATE",
        "SELECT 1--'a'FROM maps FOR UPDATE",
        "SELECT 1.FROM maps FOR UPDATE",
    ],
)
def test_locks_are_refused(statement: str) -> None:
    check_reads(statement)
    with pytest.raises(UsageError, match="locks what it reads and makes writers wait: leave it out"):
        check_limits(statement)


@pytest.mark.parametrize(
    ("statement", "named"),
    [
        ("SELECT /*+ MAX_EXECUTION_TIME(0) */ 1", "MAX_EXECUTION_TIME"),
        ("SELECT /*+ max_execution_time(100000) */ 1", "MAX_EXECUTION_TIME"),
        ("SELECT/*+SET_VAR(max_execution_time=0)*/ 1", "SET_VAR"),
        ("SELECT /*+ JOIN_ORDER(a, b) SET_VAR(sort_buffer_size = 1000000000) */ 1", "SET_VAR"),
        ("(SELECT /*+ NO_ICP(maps)\n Max_Execution_Time (0) */ name FROM maps)", "MAX_EXECUTION_TIME"),
        ("SELECT '/*' AS a, '*/', /*+ SET_VAR(a=1) */ 2", "SET_VAR"),
        ("EXPLAIN ANALYZE SELECT /*+ SET_VAR(a=1", "SET_VAR"),
    ],
)
def test_hints_that_lift_limits_are_refused(statement: str, named: str) -> None:
    with pytest.raises(UsageError, match=f"the hint {named} is not allowed here: SEMDB_SQL_TIME_LIMIT_S"):
        check_limits(statement)


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT * FROM maps /*!80000 FOR SHARE */",
        "SELECT * FROM maps /*!FOR*/ /*!SHARE*/",
        "SELECT * FROM maps /*M!100500 LOCK IN SHARE MODE */",
        "SELECT * FROM maps FOR /*!99999 nothing */ UPDATE",
        "SELECT 1 UNION SELECT /*!80000 /*+ SET_VAR(a=1) */ */ 2",
        "SELECT 1 /*! INTO OUTFILE '/tmp/x' */",
    ],
)
def test_comments_that_are_executed_are_refused(statement: str) -> None:
    with pytest.raises(UsageError, match=r"comments that are executed \(/\*M?! \.\.\. \*/\) are not allowed"):
        check_limits(statement)
    check_limits("SELECT '/*! FOR UPDATE */'")


@pytest.mark.parametrize(
    "statement",
    [
        "SELECT 'for update', \"lock in share mode\", `for share` FROM maps -- for update",
        "SELECT name /* FOR UPDATE */ FROM maps # for share",
        "SELECT '\\' FOR UPDATE' FROM maps",
        "SELECT /*+ NO_ICP(maps) */ 'SET_VAR' FROM maps",
        "SELECT /* MAX_EXECUTION_TIME(0) */ 1",
        "SELECT SUBSTRING('abc' FROM 2 FOR 1)",
        "SELECT share, mode FROM a FORCE INDEX FOR JOIN (b)",
        "SHOW CREATE TABLE maps",
        "SELECT 1; SELECT 2",
        "SELECT 'never ended for update",
        "SELECT lock_in, share FROM a",
        "SELECT für FROM größe",
        "",
    ],
)
def test_what_is_no_lock_and_no_hint_passes(statement: str) -> None:
    check_limits(statement)


def test_reading_the_statement_takes_no_time() -> None:
    """No input makes the expressions look again and again at the same characters."""
    for piece in ("/*", "/*+", "/**/", "'", "'a", "\\", "`", "--", "-- \n", "for ", "(", "\x00", "é"):
        many = piece * (60_000 // len(piece))
        check_limits("SELECT " + many)
        if piece in ("/**/", "-- \n"):
            check_reads(f"{many} SELECT 1")
