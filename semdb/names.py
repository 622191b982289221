r"""Names that hold bytes which are no UTF-8, as of files from old archives: how they are written down.

Python reads such a byte as a lone surrogate (``caf\udce9`` for the Latin-1 bytes of café), which opens the file but
fits into no database, JSON or terminal. Written down it is the six characters ``\udce9``; `path_text` makes them the
byte again. A real backslash before ``udc`` is written ``\udc5c``, so that nothing is lost.
"""

from __future__ import annotations

import re

_SURROGATE = re.compile("[\ud800-\udfff]")
_TO_ESCAPE = re.compile(r"\\(?=udc[0-9a-f]{2})|[\udc80-\udcff]")
_ESCAPED = re.compile(r"\\udc(5c|[89a-f][0-9a-f])")


def written(name: str) -> str:
    r"""`name` as it is stored and shown: each byte that is no UTF-8 as ``\udcXX``; other lone surrogates likewise."""
    if name.isascii() and "\\udc" not in name:
        return name
    escaped = _TO_ESCAPE.sub(lambda found: f"\\udc{ord(found[0]) & 0xFF:02x}", name)
    return _SURROGATE.sub(lambda found: f"\\u{ord(found[0]):04x}", escaped)


def storable(text: str) -> str:
    r"""`text` as a database, JSON or a page holds it: each lone surrogate as ``\udcXX``. Twice is as once.

    For what is a name of its own, not a path that is opened again: a real backslash stays as it is.
    """
    return text if text.isascii() else _SURROGATE.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def path_text(written_name: str) -> str:
    """The name that `written` was given, for `Path`."""
    if "\\udc" not in written_name:
        return written_name
    return _ESCAPED.sub(lambda found: "\\" if found[1] == "5c" else chr(0xDC00 | int(found[1], 16)), written_name)
