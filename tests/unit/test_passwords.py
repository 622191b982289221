"""Passwords in URLs, whatever they are: not in messages, not in the list of processes, not in the database."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.cli.secrets import password_places
from semdb.database.engine import make_engine, parse_url, safe_url
from semdb.database.retry import explain
from semdb.errors import UsageError
from semdb.recordings import open_recordings
from semdb.recordings.source import locate, write_source
from semdb.settings import Settings

# Words that are in no message, joined by what means something in a URL.
WORDS = st.text(alphabet="XQZJé", min_size=3, max_size=5)
SIGNS = st.sampled_from(["@", "/", ":", ",", "?", "#", "&", "=", "%", "[", "]", " ", "+", "@/", "//", "://", "::", ""])


@st.composite
def passwords(draw: st.DrawFn) -> tuple[str, list[str]]:
    """A password, and the words in it."""
    words = draw(st.lists(WORDS, min_size=1, max_size=4))
    signs = [draw(SIGNS) for _ in range(len(words) + 1)]
    return "".join(part for pair in zip(signs, [*words, ""], strict=True) for part in pair), words


HOSTS = st.sampled_from(["host", "host:3306", "one,two:3307", "[::1]:3306,[::1]:3307", "host:x", "one,two:x"])
TAILS = st.sampled_from(["/room", "/room?ssl_mode=DISABLED", "/room?sslmode=x", "", "/"])


def said(url: str) -> str:
    """All that messages show of `url`."""
    try:
        engine = make_engine(url)
    except UsageError as error:
        return f"{error} {error.__cause__}"
    return f"{safe_url(engine.url)} {explain(engine, RuntimeError('gone'))} {engine.url!r}"


@given(passwords(), HOSTS, TAILS)
def test_nothing_of_a_password_is_shown(password: tuple[str, list[str]], hosts: str, tail: str) -> None:
    text, words = password
    for written in (text, quote(text, safe="")):
        shown = said(f"mysql+pymysql://me:{written}@{hosts}{tail}")
        assert not [word for word in words if word in shown or quote(word) in shown], shown


@given(passwords())
def test_a_password_with_escapes_is_taken_as_it_is_meant(password: tuple[str, list[str]]) -> None:
    assert parse_url(f"mysql://me:{quote(password[0], safe='')}@one,two/room").password == password[0]


@pytest.mark.parametrize("password", ["p@ss", "pass/wort", "a,b/c", "a?b", "@", "a@b@c", "x://y"])
def test_a_password_that_needs_escapes_is_refused(password: str) -> None:
    with pytest.raises(UsageError, match=r"each @ .* as %40, and each / and [?] of user and password as") as caught:
        parse_url(f"mysql://me:{password}@host/room")
    assert password not in str(caught.value).replace("each @ of", "")


@pytest.mark.parametrize("password", ["a:b", "a,b", "a#b", "a=b&c", "[x]", "a b"])
def test_a_password_that_can_be_read_in_one_way_only_is_taken(password: str) -> None:
    url = parse_url(f"mysql://me:{password}@one,two/room")
    assert (url.password, url.host, url.database) == (password, "one", "room")


def test_a_file_may_have_any_name() -> None:
    assert parse_url("sqlite:////data/me:x@home/a@b.sqlite3").database == "/data/me:x@home/a@b.sqlite3"


# the list of processes


@given(passwords(), HOSTS, TAILS)
def test_nothing_of_a_password_stays_among_the_arguments(
    password: tuple[str, list[str]], hosts: str, tail: str
) -> None:
    text, words = password
    url = f"mysql+pymysql://mé:{text}@{hosts}{tail}"
    before = [b"semdb", b"init", b"--database-url", os.fsencode(url), f"--database-url={url}".encode(), b"after"]
    arguments = bytearray(b"\0".join(before))
    for first, last in password_places(bytes(arguments), url):
        arguments[first:last] = b"*" * (last - first)
    assert not [word for word in words if word.encode() in arguments]
    after = bytes(arguments).split(b"\0")
    assert [len(argument) for argument in after] == [len(argument) for argument in before]
    assert after[3].startswith("mysql+pymysql://mé:*".encode())
    assert after[3].endswith(f"*@{hosts}{tail}".encode())
    assert after[:3] + after[5:] == before[:3] + before[5:]


def test_what_has_no_password_stays() -> None:
    for url in ("mysql://host/room", "mysql://me@host:3306/room", "sqlite:///a:b@c", "nonsense"):
        assert list(password_places(url.encode(), url)) == []


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the list of processes is Linux'")
@pytest.mark.parametrize("password", ["p@ss@wort", "pass/wort", "a,b/wort", "bytes\udcff@wort"])
def test_a_refused_password_is_not_in_the_list_of_processes(password: str) -> None:
    url = f"mysql+pymysql://me:{password}@host/room"
    code = (
        "import sys, pathlib; from semdb.cli.options import Overrides; "
        "Overrides(database_url=sys.argv[1]).settings(); "
        "sys.stdout.buffer.write(pathlib.Path('/proc/self/cmdline').read_bytes())"
    )
    command = [sys.executable, "-c", code, url, "after"]
    shown = subprocess.run(command, stdout=subprocess.PIPE, check=True, timeout=60).stdout.split(b"\0")
    stars = b"*" * len(os.fsencode(password))
    assert shown[-3:-1] == [b"mysql+pymysql://me:" + stars + b"@host/room", b"after"]


# recordings

WITH_SECRETS = [
    "sftp://me:QXQX@host/room",
    "SFTP://me:QXQX@host:22/room",
    "sftp://me:QX@QX@host/room",
    "s3://KEY:QXQX@bucket/room",
    "https://QXQX@host/room",
    "simplecache::sftp://me:QXQX@host/room",
    "zip://room::sftp://me:QXQX@host/a.zip",
    "sftp://me:QX/QX@host/room",
    "sftp://me:QX?QX@host/room",
]
WITHOUT = [
    "s3://bucket/room",
    "sftp://me@host:22/room",
    "sftp://host:22/data/a@b",
    "sftp://[::1]:22/room",
    "zip://room::s3://bucket/a.zip",
    "github://organisation:repository@main/room",
    "abfs://container@account.dfs.core.windows.net/room",
    "file:///data/a:b@c",
]


@pytest.mark.parametrize("address", WITH_SECRETS)
def test_the_url_of_a_recording_holds_no_password(address: str, tmp_path: Path) -> None:
    for attempt in (lambda: write_source(address, None), lambda: locate(address, Settings(cache_dir=tmp_path))):
        with pytest.raises(UsageError, match=r"holds a password.*FSSPEC_[A-Z0-9]+_PASSWORD") as caught:
            attempt()
        assert "QX" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("address", WITH_SECRETS[:-2])
def test_a_password_is_not_shown_where_only_folders_are_taken(address: str) -> None:
    with pytest.raises(UsageError, match="holds a password") as caught:
        open_recordings(Path(address))  # as `semdb recording` does
    assert "QX" not in str(caught.value)


@pytest.mark.parametrize("address", WITHOUT)
def test_other_urls_of_recordings_are_kept_as_they_are(address: str) -> None:
    assert write_source(address, None) == address
