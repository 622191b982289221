"""`semdb doctor`: whether this installation can do its work, and what to do where it cannot."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from semdb.cli.options import JsonFlag, Overrides, settings_options
from semdb.rights import folder_problem
from semdb.shown import for_shell

if TYPE_CHECKING:
    from sqlalchemy import Engine

    from semdb.settings import Settings

LIBRARIES = ("numpy", "scipy", "numba", "opencv-contrib-python-headless", "onnxruntime", "poselib", "sqlalchemy")
EXTRAS = {"worker": ("celery", "redis"), "torch": ("torch", "torchvision")}


@dataclass(frozen=True, slots=True)
class Check:
    """One finding: `state` is "ok", "info" or "problem"."""

    state: str
    what: str
    text: str


@settings_options(models=True)
def command(overrides: Overrides, json: JsonFlag = False) -> None:
    """Check the installation, the database and the models.

    Exit code 1 when something is wrong.
    """
    from semdb.cli.output import print_json, print_lines
    from semdb.cli.progress import say

    settings, checked_broker = settings_of(overrides)
    parts = (versions, database, checked_broker, folders, models)
    checks = [check for part in parts for check in guarded(part, settings)]
    if json:
        print_json([{"state": check.state, "what": check.what, "text": check.text} for check in checks])
    else:
        width = max(len(check.what) for check in checks)
        for check in checks:
            print_lines(f"{check.state:<8} {check.what:<{width}}  {check.text}")
    problems = sum(check.state == "problem" for check in checks)
    if problems:
        say(f"{problems} problem{'s' if problems > 1 else ''} found")
        raise typer.Exit(1)


def settings_of(overrides: Overrides) -> tuple[Settings, Callable[[Settings], Iterator[Check]]]:
    """The settings, and what looks at the broker: a wrong URL of it is a finding, and all else is looked at, too.

    Raises UsageError for any other setting that makes no sense.
    """
    from semdb.settings import BrokerUrlError, Settings

    try:
        return overrides.settings(), broker
    except BrokerUrlError as error:
        finding = Check("problem", "broker", str(error))
        default = str(Settings.model_fields["broker_url"].default)
        return overrides.settings(broker_url=default), lambda _settings: iter([finding])


def guarded(part: Callable[[Settings], Iterator[Check]], settings: Settings) -> Iterator[Check]:
    """The findings of one part; an error of semdb ends it and is itself a finding."""
    from semdb.errors import SemdbError

    try:
        yield from part(settings)
    except SemdbError as error:
        yield Check("problem", part.__name__, str(error))


def versions(_settings: Settings) -> Iterator[Check]:
    """Python, semdb and the libraries that do the work."""
    from importlib import import_module
    from importlib.metadata import PackageNotFoundError, version

    import semdb

    yield Check("ok", "semdb", f"{semdb.__version__} in {Path(semdb.__file__).parent}")
    yield Check("ok", "python", f"{sys.version.split()[0]}, {os.cpu_count()} cores")
    for name in LIBRARIES:
        try:
            import_module("cv2" if name.startswith("opencv") else name)
            yield Check("ok", name, version(name))
        except (ImportError, OSError, PackageNotFoundError) as error:
            yield Check("problem", name, f"{error}: pip install --force-reinstall semdb")
    for extra, names in EXTRAS.items():
        try:
            yield Check("ok", f"extra {extra}", ", ".join(f"{name} {version(name)}" for name in names))
        except PackageNotFoundError:
            yield Check("info", f"extra {extra}", f"not installed: pip install 'semdb[{extra}]'")


def database(settings: Settings) -> Iterator[Check]:
    """Whether the database answers, what it is, and whether its schema is the one that this version knows."""
    from sqlalchemy import text

    from semdb.database import retry, schema
    from semdb.database.engine import make_engine, parse_url, safe_url, sqlite_path
    from semdb.database.inspection import judge, server_facts
    from semdb.database.sqlite_file import how_it_is_read

    url = parse_url(settings.database_url)
    path = sqlite_path(url)
    if path is not None and not path.exists():
        yield Check("info", "database", f"{safe_url(url)} is not there yet; `semdb init` or the first ingest makes it")
        if not os.access(path.parent if str(path.parent) else Path(), os.W_OK):
            yield Check("problem", "database", f"the folder {path.parent.resolve()} cannot be written")
        return
    engine = make_engine(settings.database_url)
    try:
        statement = "SELECT sqlite_version()" if path is not None else "SELECT VERSION()"
        version = retry.read(engine, lambda connection: str(connection.execute(text(statement)).scalar()))
        kind = "SQLite" if path is not None else "server"
        yield Check("ok", "database", f"{safe_url(url)} answers: {kind} {version}")
        if path is None:
            for finding in judge(server_facts(engine)):
                yield Check(finding.state, f"database: {finding.what}", finding.text)
        elif (line := how_it_is_read(path)) is not None:
            yield Check("problem", "database", f"{line}: nothing can be ingested or logged")
        schema.check_schema(engine)
        yield Check("ok", "schema", f"revision {schema.HEAD}")
        yield from crops(engine)
        yield from plain(engine, settings)
    finally:
        engine.dispose()


def crops(engine: Engine) -> Iterator[Check]:
    """Maps whose keyframes the encoder was shown in another way than those of a new map are."""
    from semdb.database.lookups import map_heads
    from semdb.errors import SemdbError
    from semdb.perception.model_choice import older_crop

    for head in map_heads(engine):
        try:
            found = None if head.damage else older_crop(head.models)
        except SemdbError as error:
            yield Check("problem", f"map {head.name}", str(error))
            continue
        if found is not None:
            advice = for_shell(["semdb", "ingest", "--redescribe", "encoder", "--map", head.name])
            yield Check(
                "info", f"map {head.name}", f"made with the crop {found[0]}, new maps have {found[1]}: {advice}"
            )


def plain(engine: Engine, settings: Settings) -> Iterator[Check]:
    """Maps of plain things, where another feature would be sure of more images (docs/features.md)."""
    from semdb.database.lookups import map_heads, mean_keypoints
    from semdb.localization.fallback import FallbackOptions
    from semdb.localization.learned_matching import is_learned

    counts = {} if settings.features_fallback else mean_keypoints(engine)
    for head in map_heads(engine) if counts else []:
        count = counts.get(head.id)
        if head.damage or count is None or count >= FallbackOptions().plain or is_learned(head.models):
            continue
        yield Check(
            "info",
            f"map {head.name}",
            f"its keyframes have {count:.0f} keypoints in the mean, as of plain things: many images may stay in doubt; "
            "SEMDB_FEATURES_FALLBACK=onnx:FILE is sure of more",
        )


def broker(settings: Settings) -> Iterator[Check]:
    """Whether the broker of the workers answers, where one is set."""
    if "broker_url" not in settings.model_fields_set:
        yield Check("info", "broker", "SEMDB_BROKER_URL is not set: only `semdb ingest --queue` and workers need it")
        return
    try:
        from kombu import Connection
        from kombu.exceptions import OperationalError
    except ImportError:
        yield Check("problem", "broker", "the worker extra is missing: pip install 'semdb[worker]'")
        return
    with Connection(settings.broker_url, connect_timeout=5) as connection:
        where = connection.as_uri()  # without the password
        try:
            connection.ensure_connection(max_retries=1, timeout=5)
            yield Check("ok", "broker", f"{where} answers")
        except (OperationalError, OSError) as error:
            yield Check("problem", "broker", f"{where} does not answer ({error}): start it, or set SEMDB_BROKER_URL")


def folders(settings: Settings) -> Iterator[Check]:
    """Whether compiled kernels, models and indexes can be kept."""
    for what, folder in (
        ("cache", settings.cache_dir.expanduser()),
        ("NUMBA_CACHE_DIR", Path(os.environ["NUMBA_CACHE_DIR"]) if os.environ.get("NUMBA_CACHE_DIR") else None),
    ):
        if folder is None:
            continue
        nearest = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
        problem = folder_problem(nearest) if nearest == folder else None
        if problem is not None:
            yield Check(
                "problem", what, f"{problem}: what it keeps is not used; chmod go-w, or set it to a folder of your own"
            )
        elif os.access(nearest, os.W_OK) and nearest.is_dir():
            yield Check("ok", what, str(folder) + ("" if nearest == folder else " (made when needed)"))
        else:
            yield Check(
                "problem", what, f"{folder} cannot be written; set {'SEMDB_CACHE_DIR' if what == 'cache' else what}"
            )


def models(settings: Settings) -> Iterator[Check]:
    """Whether what the settings name can be loaded. ``auto`` depends on the map, so there is nothing to load."""
    from semdb.errors import SemdbError
    from semdb.perception.detectors import load_detector
    from semdb.perception.encoders import load_encoder
    from semdb.perception.features import load_features

    loaders: dict[str, Callable[[str, Settings], object]] = {
        "detector": load_detector,
        "encoder": load_encoder,
        "features": load_features,
    }
    yield from words(settings)
    yield from learned(settings)
    for role, load in loaders.items():
        spec = str(getattr(settings, role))
        if spec == "auto":
            yield Check("ok", role, "auto: that of the map, or of the recording")
            continue
        try:
            load(spec, settings)
            yield Check("ok", role, spec)
        except SemdbError as error:
            yield Check("problem", role, str(error))


def learned(settings: Settings) -> Iterator[Check]:
    """Whether matcher and fallback of features can be loaded, where they are named."""
    from semdb.errors import SemdbError
    from semdb.perception.features import load_features
    from semdb.perception.matchers import load_matcher

    roles: tuple[tuple[str, str | None, Callable[[str, Settings], object]], ...] = (
        ("matcher", settings.matcher, load_matcher),
        ("features fallback", settings.features_fallback, load_features),
    )
    for role, spec, load in roles:
        if spec is None:
            continue
        try:
            load(spec, settings)
            yield Check("ok", role, spec)
        except SemdbError as error:
            yield Check("problem", role, str(error))


def words(settings: Settings) -> Iterator[Check]:
    """Whether words that no table has can be understood by their vectors."""
    from semdb.errors import SemdbError
    from semdb.perception.word_vectors import load_words

    try:
        network = load_words(settings)
    except SemdbError as error:
        yield Check("problem", "words", str(error))
        return
    if network is None:
        yield Check("info", "words", "SEMDB_WORDS is not set: `semdb find` knows the words of its tables only")
        return
    likeness = float(network.vectors(["mug"])[0] @ network.vectors(["cup"])[0])
    yield Check("ok", "words", f"{network.info.name}: mug is like cup by {likeness:.2f}")
