"""Lists of a service page by page, in both directions; a path names no other host."""

from __future__ import annotations

import json
from typing import Any

import pytest

import semdb
from semdb.errors import UsageError

httpx = pytest.importorskip("httpx")


def served(asked: list[str], by: str) -> Any:
    """A service with one list of five items, two a page, forwards (after) or the newest first (before)."""

    def answer(request: Any) -> Any:
        asked.append(str(request.url.host))
        items = [1, 2, 3, 4, 5] if by == "after" else [5, 4, 3, 2, 1]
        key = request.url.params.get(by)
        left = items if key is None else items[items.index(int(key)) + 1 :]
        count = min(2, int(request.url.params["limit"]))
        last = str(left[count - 1]) if len(left) > count else None
        following = None if last is None else f"/v1/list?limit=2&{by}={last}"
        return httpx.Response(200, content=json.dumps({"items": left[:count], "next": following, "key": last}))

    return httpx.MockTransport(answer)


@pytest.mark.parametrize(("by", "expected"), [("after", [1, 2, 3, 4, 5]), ("before", [5, 4, 3, 2, 1])])
def test_all_pages_of_a_list_come_once(by: str, expected: list[int]) -> None:
    with semdb.connect("http://127.0.0.1:8765") as db:
        db._transport.handler = served([], by)
        assert list(db.pages("/v1/list")) == expected
        assert list(db.pages("/v1/list", **{by: 3})) == expected[3:]
        assert list(db.pages("/v1/list", limit=3)) == expected[:3]


@pytest.mark.parametrize("path", ["@elsewhere/x", "9/x", ".elsewhere/x", "", "http://elsewhere/x"])
def test_a_path_names_no_other_host(path: str) -> None:
    asked: list[str] = []
    with semdb.connect("http://127.0.0.1:8765", token="t" * 40) as db:
        db._transport.handler = served(asked, "after")
        with pytest.raises(UsageError, match="begins with a slash"):
            db.get(path)
    assert asked == []
