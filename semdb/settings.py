"""One typed settings object. Every field is an environment variable with the prefix ``SEMDB_``."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import Field, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from semdb.errors import UsageError

# What Celery's transport library knows, in small letters.
_BROKERS = (
    "redis rediss sentinel amqp amqps pyamqp librabbitmq qpid sqs kafka confluentkafka mongodb zookeeper sqlalchemy "
    "sqla slmq filesystem consul etcd azurestoragequeues azureservicebus pyro gcpubsub pgmq memory"
)


class BrokerUrlError(UsageError):
    """SEMDB_BROKER_URL names no broker. The message leaves the URL out, which may hold a password."""


def check_broker_url(url: str) -> str:
    """`url`, which may be several divided by semicolons. Raises BrokerUrlError for what is no address of a broker."""
    for one in url.split(";"):
        scheme, found, _ = one.partition("://")
        kind = scheme.partition("+")[0].lower()  # sqla+sqlite: a driver of that transport
        if not found:
            raise BrokerUrlError(
                "SEMDB_BROKER_URL is no URL: write redis://HOST:PORT/N, or another of Celery's brokers"
            )
        if kind not in _BROKERS.split():
            raise BrokerUrlError(
                f"SEMDB_BROKER_URL: there is no broker of the kind {scheme!r}: redis, rediss, amqp, ..."
            )
        try:
            parsed = urlsplit(one)
            _ = "," in parsed.netloc or parsed.port  # of several hosts only the transport knows what to make
        except ValueError:
            raise BrokerUrlError("SEMDB_BROKER_URL: host or port make no sense: write redis://HOST:PORT/N") from None
        if scheme in ("redis", "rediss") and parsed.path.strip("/") and not parsed.path.strip("/").isdigit():
            raise BrokerUrlError("SEMDB_BROKER_URL: a database of Redis is a number: redis://HOST:PORT/N")
    return url


def split_roots(text: str) -> tuple[str, ...]:
    """Absolute folders and URLs, divided as in PATH; the colon of a URL divides nothing. Raises ValueError."""
    roots = tuple(root for root in re.split(rf"{os.pathsep}(?!//)", text) if root.strip())
    if not roots:
        raise ValueError("names no folder: name one, or unset it to allow all")
    for root in roots:
        if not os.path.isabs(root) and "://" not in root:
            raise ValueError(f"{root!r} is neither an absolute folder nor a URL")
    return roots


class Settings(BaseSettings):
    """Settings of semdb. Options of commands override them; they override the defaults here."""

    model_config = SettingsConfigDict(env_prefix="SEMDB_", extra="ignore")

    database_url: str = Field(
        "sqlite:///semdb.sqlite3", description="sqlite:///FILE or mysql+pymysql://USER:PASSWORD@HOST/SCHEMA"
    )
    reader_url: str | None = Field(None, description="SELECT-only account that `semdb sql` uses on a server")
    detector: str = Field(
        "auto",
        description="auto, onnx:FILE, torchvision:NAME or recorded. auto: a query takes the map's own; an ingest takes "
        "the recording's masks and says so",
    )
    encoder: str = Field(
        "auto", description="auto, onnx:FILE, torchvision:NAME or gist. auto: a query takes the map's own"
    )
    encoder_crop: Literal["auto", "centre", "height", "squashed", "padded"] = Field(
        "auto", description="what of an image a place network is shown. auto: a query as the map's keyframes were"
    )
    features: str = Field("auto", description="auto, surf, sift, orb or onnx:FILE. auto: the map's own, or surf")
    features_fallback: str | None = Field(
        None, description="a feature that is asked where that of the map does not convince, as onnx:FILE; default: none"
    )
    matcher: str | None = Field(
        None, description="onnx:FILE: a network that matches learned features; default: nearest neighbours"
    )
    words: str | None = Field(
        None, description="onnx:FILE: a sentence network for words that `semdb find` does not know; default: none"
    )
    device: str = Field(
        "auto",
        pattern=r"^(auto|cpu|mps|cuda(:\d+)?)$",
        description="device of the networks: auto, cpu, cuda, cuda:1, mps",
    )
    batch: Literal["auto"] | Annotated[int, Field(ge=1, le=64)] = Field(
        "auto", description="images that go through the networks at once in an ingest. auto: 8 on a GPU, 1 on a CPU"
    )
    classes: str | None = Field(None, description="only objects of these classes: names, indoor, or all")
    dynamic: str | None = Field(None, description="classes of objects that move: no feature lies on them; or none")
    score_threshold: float = Field(0.5, ge=0.0, le=1.0, description="detections below are not kept")
    max_keypoints: int = Field(1500, ge=50, le=20000, description="keypoints kept per image, by response")
    threads: int = Field(2, ge=1, le=256, description="threads of one process for networks and kernels")
    cache_dir: Path = Field(Path("~/.cache/semdb"), description="model files in models/, indexes in index/")
    index_exact_up_to: int = Field(
        20_000, ge=0, description="keyframes of a map up to which an index compares every vector exactly"
    )
    broker_url: str = Field(
        "redis://localhost:6379/0", description="broker of the workers, redis://HOST:PORT/N or another of Celery's"
    )
    log_format: Literal["text", "json"] = Field("text", description="json: each event is one line of JSON on stderr")
    metrics_port: int | None = Field(
        None, ge=1, le=65535, description="a worker serves Prometheus metrics on this port; default: not at all"
    )
    descriptor_dtype: Literal["auto", "float32", "float16", "uint8"] = Field(
        "auto",
        description="how descriptors of float are stored: float32, float16 (half the room), uint8 (a quarter). auto: "
        "as the map has them, float32 in a new one",
    )
    keep_images: Literal["original", "jpeg", "none"] = Field(
        "original",
        description="what is kept of image files: original, jpeg (colour as JPEG where that is smaller), none (small "
        "grey images that localization needs, no depth)",
    )
    check_recordings: bool = Field(
        True, description="an ingest looks first whether a recording's images fit what it says of itself"
    )
    recording_roots: str | None = Field(
        None, description="folders and URLs below which recordings may lie, divided by colons; default: anywhere"
    )
    sql_time_limit_s: float = Field(60.0, gt=0, description="time limit of `semdb sql`")

    @property
    def roots(self) -> tuple[str, ...]:
        """The entries of `recording_roots`; () where nothing is set."""
        return () if self.recording_roots is None else split_roots(self.recording_roots)

    @field_validator("recording_roots")
    @classmethod
    def _recording_roots(cls, text: str | None) -> str | None:
        if text is not None:
            split_roots(text)
        return text

    @field_validator("broker_url")
    @classmethod
    def _broker_url(cls, url: str) -> str:
        return check_broker_url(url)


def settings_with(given: Mapping[str, object], option: Callable[[str], str] = "{}=".format) -> Settings:
    """The settings of the environment under those that are `given` by name.

    Raises UsageError naming the variable, or the `option` that a name was given as.
    """
    unknown = sorted(set(given) - set(Settings.model_fields))
    if unknown:
        raise UsageError(f"there is no setting {unknown[0]!r}; settings are {', '.join(Settings.model_fields)}")
    try:
        return Settings(**given)  # type: ignore[arg-type]
    except ValidationError as error:
        problems = []
        for detail in error.errors():
            name = str(detail["loc"][0]) if detail["loc"] else ""
            where = option(name) if name in given else f"SEMDB_{name.upper()}="
            problems.append(f"{where}{detail['input']}: {detail['msg']}")
        raise UsageError("; ".join(problems)) from None
