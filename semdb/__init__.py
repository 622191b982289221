"""semdb: a visual semantic database of indoor places."""

__version__ = "0.1.0"
