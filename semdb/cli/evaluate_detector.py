"""`semdb evaluate-detector`: COCO's scores of a detector."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from semdb.cli.options import load_settings


def command(
    detector: Annotated[str, typer.Argument(metavar="SPEC", help="torchvision:NAME, torchvision:PATH or onnx:FILE.")],
    coco: Annotated[
        Path, typer.Option(metavar="DIR", help="COCO-format data: annotations/instances_SPLIT.json, SPLIT/.")
    ],
    split: Annotated[str, typer.Option(help="Split to evaluate on.")] = "val",
    classes: Annotated[str, typer.Option(metavar="NAMES", help="Classes divided by commas, indoor or all.")] = "all",
    device: Annotated[str | None, typer.Option(metavar="NAME", help="Device; over SEMDB_DEVICE.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the scores as JSON.")] = None,
) -> None:
    """Average precision and recall of a detector on COCO-format data, beside those of the paper."""
    import json
    from dataclasses import asdict

    from semdb.cli.output import print_lines, print_table
    from semdb.cli.progress import Progress, say
    from semdb.cli.train import classes_of
    from semdb.jsonable import to_jsonable
    from semdb.perception.detectors import load_detector
    from semdb.training.coco import load_coco
    from semdb.training.evaluation import LEAST_SCORE, MEASURES, PAPER, evaluate_detector

    settings = load_settings(score_threshold=LEAST_SCORE, **({} if device is None else {"device": device}))
    data = load_coco(coco, split, classes_of(coco, split, classes))
    for note in data.notes:
        say(note)
    loaded = load_detector(detector, settings)
    with Progress("detecting", unit="images") as progress:
        found = evaluate_detector(loaded, data, progress.update)
    if json_file is not None:
        classes_found = {name: value if value >= 0 else None for name, value in found.class_ap50.items()}
        kept = {**asdict(found), "class_ap50": classes_found}
        scores = to_jsonable({"detector": loaded.info.name, "data": str(data.file), **kept})
        json_file.write_text(json.dumps(scores) + "\n")
    if found.marked:
        say(
            f"{found.marked} image(s) have an orientation mark, which is not applied: annotations must be of the "
            "pixels as stored"
        )
    print_lines(f"{loaded.info.name} on {data.file}: {found.images} images, {found.objects} objects")
    rows = [
        [what, *(f"{value:.3f}" for value in scores.values)]
        for what, scores in (
            ("boxes", found.boxes),
            ("boxes, paper on COCO minival", PAPER.boxes),
            ("masks", found.masks),
            ("masks, paper on COCO minival", PAPER.masks),
        )
    ]
    print_table(("", *MEASURES), rows)
    per_class = (f"{name} {value:.3f}" if value >= 0 else f"{name} none" for name, value in found.class_ap50.items())
    print_lines("AP50 of boxes: " + ", ".join(per_class))
