"""The coarse step from memory: a mirror of a map's class counts and vectors, see docs/localization.md."""

from semdb.localization.index.map_index import MapIndex
from semdb.localization.index.mirror import IndexOptions
from semdb.localization.index.source import IndexSource

__all__ = ["IndexOptions", "IndexSource", "MapIndex"]
