"""`semdb models`: which models made the rows, and which can be named in settings."""

from __future__ import annotations

from typing import Any

import typer

from semdb.cli.options import JsonFlag, Overrides, settings_options

command = typer.Typer(
    help="The networks and features that describe images.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
)

# role, spec, needs a file, what it is
SPECS = (
    ("detector", "recorded", False, "object masks that come with the recording"),
    ("detector", "onnx:FILE", True, "a Mask R-CNN with the outputs boxes, labels, scores, masks"),
    ("encoder", "gist", False, "training-free global descriptor"),
    ("encoder", "onnx:FILE", True, "a CNN from image [B,3,224,224] (RGB, 0..1) to embedding"),
    ("features", "surf", False, "SURF, 64 dimensions"),
    ("features", "sift", False, "SIFT of OpenCV"),
    ("features", "orb", False, "ORB of OpenCV, binary"),
)


@command.callback()
def group() -> None:
    """The networks and features that describe images."""  # keeps `list` a subcommand while it is the only one


@command.command("list")
@settings_options(models=True)
def list_models(overrides: Overrides, json: JsonFlag = False) -> None:
    """List the specs that settings can name, what is set, and which models made the rows of each map."""
    from semdb.cli.output import print_json, print_table

    settings = overrides.settings()
    chosen = {role: str(getattr(settings, role)) for role in ("detector", "encoder", "features")}
    used = used_models(settings.database_url)
    if json:
        specs = [{"role": r, "spec": s, "needs_file": f, "description": d} for r, s, f, d in SPECS]
        print_json({"specs": specs, "settings": chosen, "maps": used})
        return
    print_table(("role", "spec", "description"), [(role, spec, text) for role, spec, _, text in SPECS])
    print("\nset: " + ", ".join(f"{role} {spec}" for role, spec in chosen.items()))
    if not used:
        print("maps: " + ("no database yet" if used is None else "none yet"))
        return
    print()
    columns = ("map", "role", "name", "sha256", "config")
    print_table(columns, [(u["map"], u["role"], u["name"], u["sha256"][:12], u["config"]) for u in used])


def used_models(url: str) -> list[dict[str, Any]] | None:
    """The models of each map, None where there is no database file yet. Raises `DatabaseError`."""
    from semdb.database.engine import parse_url, sqlite_path
    from semdb.database.store import open_store

    path = sqlite_path(parse_url(url))
    if path is not None and not path.exists():
        return None
    with open_store(url) as store:
        return [
            {"map": known.name, "role": m.role, "name": m.name, "sha256": m.sha256, "config": m.config}
            for known in store.maps()
            for m in store.map_models(known.id)
        ]
