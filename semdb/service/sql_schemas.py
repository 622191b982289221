"""What answers to statements look like, for the OpenAPI document."""

from __future__ import annotations

from typing import Any, Literal

from semdb.service.schemas import Model


class Rows(Model):
    """Rows of a statement. `truncated`: there were more."""

    columns: list[str]
    rows: list[list[Any]]
    truncated: bool


class AboutTable(Model):
    """What a table or view is for, and what its columns are."""

    kind: Literal["table", "view"]
    about: str
    columns: dict[str, str]


class Tables(Model):
    """Columns by table or view, and what those of the schema are for."""

    tables: dict[str, list[str]]
    about: dict[str, AboutTable]


class Question(Model):
    """A statement of the cookbook."""

    title: str
    about: str
    sql: str


class Questions(Model):
    """The statements of docs/sql.md."""

    questions: list[Question]
