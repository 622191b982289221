"""The one door for programs: `semdb.open` gives a `Database`; commands and the service go through it too."""

from semdb.api.database import Database, open_database
from semdb.api.reading import Status
from semdb.door.protocol import SemanticDatabase
from semdb.door.seen import Seen
from semdb.door.values import Answer, Keyframe, Rows, SeenObject

__all__ = [
    "Answer",
    "Database",
    "Keyframe",
    "Rows",
    "Seen",
    "SeenObject",
    "SemanticDatabase",
    "Status",
    "open_database",
]
