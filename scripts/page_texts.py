"""Writes what the page of the service says of tables, from docs/schema.md, and its questions, from docs/sql.md."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "semdb" / "service" / "page_texts.json"
LINK = re.compile(r"\[([^\]]+)\]\([^)]*\)")


def plain(text: str) -> str:
    """A text of a page of docs as one line without marks."""
    return " ".join(LINK.sub(r"\1", text).replace("`", "").split())


def tables() -> dict[str, Any]:
    """Of each table and view: its kind, what it is for, and what its columns are."""
    found: dict[str, Any] = {}
    kind = name = ""
    for line in (ROOT / "docs" / "schema.md").read_text().splitlines():
        if line.startswith("## "):
            kind, name = {"## Tables": "table", "## Views": "view"}.get(line, ""), ""
        elif line.startswith("### ") and kind:
            name = line[4:].strip()
            found[name] = {"kind": kind, "about": "", "columns": {}}
        elif name and line.startswith("| `"):
            column, _, text = line[3:].partition("` | ")
            found[name]["columns"][column] = plain(text.rstrip().removesuffix("|"))
        elif name and line.strip() and not line.startswith("|") and not found[name]["columns"]:
            found[name]["about"] = plain(f"{found[name]['about']} {line}")
    return found


def questions() -> list[dict[str, str]]:
    """The queries of the cookbook with what they answer."""
    found: list[dict[str, str]] = []
    head, texts, query = "", [], None
    for line in (ROOT / "docs" / "sql.md").read_text().splitlines():
        if query is not None:
            if line.startswith("```"):
                found.append({"title": plain(head), "about": plain(" ".join(texts)), "sql": "\n".join(query)})
                query, texts = None, []
            else:
                query.append(line)
        elif line.startswith("```sql"):
            query = []
        elif line.startswith("## "):
            head, texts = line[3:], []
        elif line.strip() and head:
            texts.append(line)
    return found


def text() -> str:
    """All of it as JSON."""
    return json.dumps({"tables": tables(), "questions": questions()}, ensure_ascii=False, indent=1) + "\n"


if __name__ == "__main__":
    OUT.write_text(text())
