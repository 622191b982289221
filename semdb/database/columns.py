"""What the columns of the tables are made of: types for SQLite and servers alike, and columns that many tables have."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    DateTime,
    Double,
    ForeignKey,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    Text,
    TypeDecorator,
    func,
)
from sqlalchemy.dialects.mysql import LONGBLOB, LONGTEXT
from sqlalchemy.engine import Dialect

from semdb.names import storable
from semdb.storable_names import NAME_LENGTH

NAMING = {
    "ix": "ix_%(table_name)s_%(column_0_N_name)s",
    "uq": "uq_%(table_name)s_%(column_0_N_name)s",
    "fk": "fk_%(table_name)s_%(column_0_name)s",
    "pk": "pk_%(table_name)s",
}
metadata = MetaData(naming_convention=NAMING)


class _Bytes(LargeBinary):
    """Blobs as the driver gives them: what SQLite may have in their columns is looked at where it is used."""

    def result_processor(self, dialect: Any, coltype: Any) -> None:
        return None


class Moment(TypeDecorator[Any]):
    """Times; what is none comes as it is, and is looked at where it is used."""

    impl = DateTime
    cache_ok = True

    def result_processor(self, dialect: Any, coltype: Any) -> Any:
        return _as_moment if dialect.name == "sqlite" else None


def _as_moment(value: Any) -> Any:
    try:
        return datetime.fromisoformat(value)
    except (TypeError, ValueError):
        return value


# SQLite counts rows up only in a column of type INTEGER; MySQL's BLOB ends at 64 KiB, its TEXT too.
Id = BigInteger().with_variant(Integer(), "sqlite")
Blob = _Bytes().with_variant(LONGBLOB(), "mysql", "mariadb")


class Name(TypeDecorator[str]):
    """Text from outside, of at most so many characters where it has a length.

    File names on Linux are bytes, and Python reads those that are no UTF-8 as lone surrogates, which no server takes.
    """

    impl = String
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """What is sent to the server."""
        return value if value is None else storable(value)


class Words(Name):
    """As `Name`, of any length."""

    impl = Text
    cache_ok = True


LongText = Text().with_variant(LONGTEXT(), "mysql", "mariadb")
POSE_COLUMNS = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
STRENGTH_COLUMNS = ("upper_strength", "lower_strength", "keyframe_strength")


def table(name: str, *columns: Any) -> Table:
    """A table with the options of both servers: InnoDB, binary collation, row ids that are never used twice."""
    return Table(
        name,
        metadata,
        *columns,
        mysql_engine="InnoDB",
        mysql_charset="utf8mb4",
        mysql_collate="utf8mb4_bin",
        sqlite_autoincrement=any(isinstance(c, Column) and c.primary_key and c.name == "id" for c in columns),
    )


def row_id() -> Column[int]:
    return Column("id", Id, primary_key=True, autoincrement=True)


def reference(name: str, target: str, *, cascade: bool = True, nullable: bool = False, **options: Any) -> Column[int]:
    foreign_key = ForeignKey(target, ondelete="CASCADE" if cascade else None)
    return Column(name, Id, foreign_key, nullable=nullable, autoincrement=False, **options)


def maybe(name: str, target: str) -> Column[int]:
    """What a row refers to while it is there."""
    return Column(name, Id, ForeignKey(target, ondelete="SET NULL"), autoincrement=False, index=True)


def moment(name: str) -> Column[Any]:
    return Column(name, Moment, nullable=False, server_default=func.current_timestamp())


def pose_columns(prefix: str = "") -> list[Column[Any]]:
    return [Column(f"{prefix}{name}", Double, nullable=False) for name in POSE_COLUMNS]


def link_columns() -> list[Column[Any]]:
    """The pose of another keyframe in the frame of one, and why it is believed."""
    return [
        *pose_columns(),
        Column("information", Blob, nullable=False),
        Column("inliers", Integer, nullable=False),
        Column("state", String(16), nullable=False),
        Column("reason", Words, nullable=False),
        Column("provenance", String(NAME_LENGTH), nullable=False),
    ]
