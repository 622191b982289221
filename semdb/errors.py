"""Every error that a user can cause. The command line catches `SemdbError` once, at its entry point."""

from __future__ import annotations


class SemdbError(Exception):
    """Base of all errors of semdb. The message says what is wrong, where, and what to do about it."""

    exit_code = 1


class UsageError(SemdbError):
    """The command or a setting makes no sense as given (exit code 2)."""

    exit_code = 2


class RecordingError(SemdbError):
    """A recording cannot be used at all; the message names the file and, where there is one, the line."""


class RecordingUnavailableError(RecordingError):
    """The folder of a recording is not there now: a mount that was lost may come back."""


class FrameError(SemdbError):
    """One frame of a recording, or one query image, cannot be read; the rest of the recording can."""


class ModelError(SemdbError):
    """A detector, encoder or feature is missing, broken or not what it claims to be."""


class TrainingError(SemdbError):
    """Training data or a training run cannot be used; the message names the file and what in it is wrong."""


class DatabaseError(SemdbError):
    """The database does not answer, or refused a statement for good."""


class DatabaseUnavailableError(DatabaseError):
    """The database does not answer or has no room now; the same work may succeed later."""


class UnstorableError(DatabaseError):
    """A value that no attempt will store: larger than the server takes, or than its column holds."""


class LeaseLostError(DatabaseError):
    """Another worker has taken over what this one was working on: nothing was written."""


class SchemaError(DatabaseError):
    """The schema is older or newer than this version of semdb, or is not there."""


class ProvenanceError(DatabaseError):
    """Rows were made by other models than those that would be compared with them."""


class CodecError(DatabaseError):
    """A blob in the database is not what its header, or its row, says."""


class NotFoundError(DatabaseError):
    """A map, recording or keyframe of that name or id does not exist."""
