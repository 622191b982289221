"""Texts that only this service, or one with the same secret, can have made: sessions and confirmations."""

from __future__ import annotations

import base64
import binascii
import hashlib
import hmac
import json
import time
from typing import Any

LONGEST = 4096
_MAC = 32


def signed(secret: bytes, kind: str, content: dict[str, Any], seconds: float) -> str:
    """`content` that is valid for so long, as text for addresses."""
    body = json.dumps([kind, int(time.time() + seconds), content], separators=(",", ":")).encode()
    return base64.urlsafe_b64encode(_mac(secret, body) + body).rstrip(b"=").decode()


def opened(secret: bytes, kind: str, text: str) -> dict[str, Any] | None:
    """What was signed; None where it was not, or not as this `kind`, or its time is over."""
    if len(text) > LONGEST or not text.isascii():
        return None
    try:
        data = base64.urlsafe_b64decode(text + "=" * (-len(text) % 4))
    except (ValueError, binascii.Error):
        return None
    mac, body = data[:_MAC], data[_MAC:]
    if not hmac.compare_digest(mac, _mac(secret, body)):
        return None
    found, until, content = json.loads(body)
    return content if found == kind and time.time() < until else None


def _mac(secret: bytes, body: bytes) -> bytes:
    return hmac.new(secret, body, hashlib.sha256).digest()
