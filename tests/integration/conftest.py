"""Stores on both servers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from semdb.database import schema
from semdb.database.engine import make_engine
from semdb.database.store import Store, open_store


@pytest.fixture
def database_url(empty_url: str) -> str:
    """The URL of a database with the schema and nothing in it."""
    engine = make_engine(empty_url)
    schema.upgrade(engine)
    engine.dispose()
    return empty_url


@pytest.fixture
def store(database_url: str) -> Iterator[Store]:
    with open_store(database_url) as opened:
        yield opened
