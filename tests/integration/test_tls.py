"""TLS to a server with a certificate that it signed itself, and what the URL may ask for."""

from __future__ import annotations

import datetime
import ipaddress
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from sqlalchemy import text

from semdb.database.engine import make_engine, parse_url
from semdb.database.retry import read
from semdb.errors import DatabaseError, UsageError
from tests import servers


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
def server(certificates: Path) -> Iterator[servers.Server]:
    files = {"cert": certificates / "server.pem", "key": certificates / "server.key"}
    with servers.server(*(f"--ssl-{name}={path}" for name, path in files.items())) as made:
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
    assert cipher(server.url(query="?ssl_mode=REQUIRED")) != ""
    for mode in ("", "&ssl_mode=VERIFY_CA", "&ssl_mode=VERIFY_IDENTITY"):
        assert cipher(server.url(query=f"?ssl_ca={certificates / 'server.pem'}{mode}")) != ""


def test_a_certificate_that_is_not_trusted_is_refused(server: servers.Server, certificates: Path) -> None:
    with pytest.raises(DatabaseError, match=r"does not answer|refused") as caught:
        cipher(server.url(query=f"?ssl_ca={certificates / 'elsewhere.pem'}"))
    assert servers.PASSWORD not in str(caught.value)
    name = server.url(query=f"?ssl_ca={certificates / 'server.pem'}").replace("127.0.0.1", "localhost")
    with pytest.raises(DatabaseError):
        cipher(name)


def test_a_server_without_tls_is_refused_where_the_url_asks_for_it(mariadb_url: str) -> None:
    assert cipher(f"{mariadb_url}?ssl_mode=DISABLED") == ""
    with pytest.raises(DatabaseError):
        cipher(f"{mariadb_url}?ssl_mode=REQUIRED")


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("sslmode=REQUIRED", "has a parameter 'sslmode'; known are ssl_ca"),
        ("ssl_mode=SOMETIMES", "it is one of DISABLED"),
        ("ssl_mode=VERIFY_CA", "needs ssl_ca=FILE"),
        ("ssl_ca=/no/such/file", "there is no such file"),
    ],
)
def test_parameters_that_make_no_sense(query: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        parse_url(f"mysql+pymysql://me:secret@host/schema?{query}")
    assert "secret" not in str(caught.value)
