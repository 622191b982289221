"""TLS to a server with a certificate that it signed itself, and what the URL may ask for."""

from __future__ import annotations

import datetime
import ipaddress
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pymysql
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from semdb.database.engine import make_engine, parse_url
from semdb.database.retry import explain, read
from semdb.errors import DatabaseError, UsageError
from tests import servers
from tests.conftest import REPOSITORY


def write_certificate(folder: Path, name: str, host: str) -> tuple[Path, Path]:
    """A key and a certificate for `host` (an address), signed with that key."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    start = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=1)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(start)
        .not_valid_after(start + datetime.timedelta(days=30))
        .add_extension(x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(host))]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    paths = folder / f"{name}.key", folder / f"{name}.pem"
    paths[0].write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    paths[1].write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    for path in paths:
        path.chmod(0o644)
    return paths


@pytest.fixture(scope="module")
def certificates() -> Iterator[Path]:
    with servers.server_folder() as folder:
        folder.chmod(0o755)
        write_certificate(folder, "server", "127.0.0.1")
        write_certificate(folder, "elsewhere", "192.0.2.1")
        yield folder


@pytest.fixture(scope="module")
def server(server_kind: servers.Kind, certificates: Path) -> Iterator[servers.Server]:
    files = {"cert": certificates / "server.pem", "key": certificates / "server.key"}
    with servers.server(
        server_kind, *server_kind.with_tls, *(f"--ssl-{n}={path}" for n, path in files.items())
    ) as made:
        yield made


def cipher(url: str) -> str:
    """The cipher of a connection; empty without TLS."""
    engine = make_engine(url)
    try:
        return read(engine, lambda c: str(c.execute(text("SHOW SESSION STATUS LIKE 'Ssl_cipher'")).one()[1]))
    finally:
        engine.dispose()


def test_the_url_decides(server: servers.Server, certificates: Path) -> None:
    assert cipher(server.url(query="?ssl_mode=DISABLED")) == ""
    for query in ("", "?ssl_mode=PREFERRED", "?ssl_mode=REQUIRED"):
        assert cipher(server.url(query=query)) != ""
    for mode in ("", "&ssl_mode=VERIFY_CA", "&ssl_mode=VERIFY_IDENTITY"):
        assert cipher(server.url(query=f"?ssl_ca={certificates / 'server.pem'}{mode}")) != ""


def test_the_oldest_driver_that_is_allowed_prefers_tls() -> None:
    """Before 1.2.0 the driver connected without TLS where it was not told to."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    assert [line for line in project["dependencies"] if line.startswith("pymysql")] == ["pymysql[rsa]>=1.2.0,<2"]


def test_a_certificate_that_is_not_trusted_is_refused(server: servers.Server, certificates: Path) -> None:
    where = "answers, but TLS failed: check that ssl_ca of SEMDB_DATABASE_URL is"
    with pytest.raises(DatabaseError, match=rf"{where}.*self-signed certificate") as caught:
        cipher(server.url(query=f"?ssl_ca={certificates / 'elsewhere.pem'}"))
    assert str(server.admin.password) not in str(caught.value)
    name = server.url(query=f"?ssl_ca={certificates / 'server.pem'}").replace("127.0.0.1", "localhost")
    with pytest.raises(DatabaseError, match=rf"{where}.*mismatch"):
        cipher(name)


def test_a_server_without_tls_is_refused_where_the_url_asks_for_it(server_url: str) -> None:
    assert cipher(f"{server_url}?ssl_mode=DISABLED") == ""
    assert cipher(f"{server_url}?ssl_mode=PREFERRED") == ""
    with pytest.raises(DatabaseError, match="has no TLS, and SEMDB_DATABASE_URL asks for it"):
        cipher(f"{server_url}?ssl_mode=REQUIRED")


def test_a_server_that_takes_tls_only(server: servers.Server) -> None:
    server.execute("DROP USER IF EXISTS 'careful'@'127.0.0.1'")
    server.execute("CREATE USER 'careful'@'127.0.0.1' IDENTIFIED BY 'hush' REQUIRE SSL")
    server.execute("GRANT ALL ON semdb.* TO 'careful'@'127.0.0.1'")
    url = f"mysql+pymysql://careful:hush@127.0.0.1:{server.port}/semdb"
    assert cipher(url) != ""
    with pytest.raises(DatabaseError, match=r"takes encrypted connections only: remove ssl_mode=DISABLED"):
        cipher(f"{url}?ssl_mode=DISABLED")
    mysql = OperationalError("", {}, pymysql.err.OperationalError(3159, "insecure transport"))  # MariaDB says 1045
    engine = make_engine(url)
    assert "refuses: takes encrypted connections only" in str(explain(engine, mysql))
    cut = OperationalError("", {}, pymysql.err.OperationalError(2003, "([SSL: UNEXPECTED_EOF_WHILE_READING] EOF)"))
    assert "does not answer: check that the server runs" in str(explain(engine, cut))


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("sslmode=REQUIRED", "has a parameter 'sslmode'; known are ssl_ca"),
        ("passwd=secret", "has a parameter 'passwd'; known are ssl_ca"),
        ("ssl_mode=SOMETIMES", "it is one of DISABLED"),
        ("ssl_mode=VERIFY_CA", "needs ssl_ca=FILE"),
        ("ssl_ca=/no/such/file", "there is no such file"),
    ],
)
def test_parameters_that_make_no_sense(query: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        parse_url(f"mysql+pymysql://me:secret@host/schema?{query}")
    assert "secret" not in str(caught.value)
