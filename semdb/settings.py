"""One typed settings object. Every field is an environment variable with the prefix ``SEMDB_``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


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
    features: str = Field("auto", description="auto, surf, sift or orb. auto: the map's own, or surf")
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
    descriptor_dtype: Literal["float32", "float16"] = Field(
        "float32", description="how descriptors of float are stored; float16 takes half the room"
    )
    sql_time_limit_s: float = Field(60.0, gt=0, description="time limit of `semdb sql`")
