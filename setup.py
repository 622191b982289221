"""Names the Python that is needed, where pip would name a dependency instead. All else is in pyproject.toml."""

import sys

if sys.version_info < (3, 11):  # noqa: UP036
    sys.exit(
        f"semdb needs Python 3.11 or newer, and this is {sys.version.split()[0]}: "
        "docs/install.md says how to have one beside the distribution's"
    )

from setuptools import setup

setup()
