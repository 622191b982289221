"""Where recordings may lie: a worker opens what messages name, and who can send one need not be let read all files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit

from semdb.errors import UsageError

_LOCAL = ("file", "local")  # schemes of this machine's own folders


def check_root(address: str, roots: Sequence[str]) -> None:
    """Raises UsageError for a folder or URL below none of `roots`; () allows all.

    Links are followed first: one that leads out of a root is outside. Of URLs, those that hold another one, or climb
    with ``..``, are below none.
    """
    if roots and not any(_is_below(address, root) for root in roots):
        raise UsageError(f"{address}: recordings may lie below {', '.join(roots)} only (SEMDB_RECORDING_ROOTS)")


def places_of(roots: Sequence[str], copies: Path) -> tuple[Path, ...]:
    """The folders below which files of recordings may lie, for `semdb.files.only_below`; () where that is anywhere.

    `copies` is where those of URLs are.
    """
    if not roots:
        return ()
    folders = [folder for folder in map(_folder, roots) if folder is not None]
    return tuple(folder.resolve() for folder in (*folders, copies))


def _is_below(address: str, root: str) -> bool:
    folder, base = _folder(address), _folder(root)
    if folder is not None and base is not None:
        try:
            return folder.resolve().is_relative_to(base.resolve())
        except (OSError, ValueError, RuntimeError):  # a NUL, links that go round
            return False
    if folder is not None or base is not None or "::" in address:
        return False
    prefix = root.rstrip("/")
    steps = unquote(address).replace("\\", "/").split("/")
    return (address == prefix or address.startswith(f"{prefix}/")) and ".." not in steps


def _folder(address: str) -> Path | None:
    """The folder of this machine that `address` is; None for one of another file system."""
    if "://" not in address:
        return Path(address)
    parts = urlsplit(address)
    return Path(unquote(parts.path)) if parts.scheme in _LOCAL and not parts.netloc else None
