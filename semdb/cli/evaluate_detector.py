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

    from semdb.cli.output import print_lines, print_table, to_jsonable
    from semdb.cli.progress import Progress
    from semdb.cli.train import classes_of
    from semdb.perception.detectors import load_detector
    from semdb.training.coco import load_coco
    from semdb.training.evaluation import LEAST_SCORE, MEASURES, PAPER, evaluate_detector

    settings = load_settings(score_threshold=LEAST_SCORE, **({} if device is None else {"device": device}))
    data = load_coco(coco, split, classes_of(coco, split, classes))
    loaded = load_detector(detector, settings)
    with Progress("detecting", unit="images") as progress:
        found = evaluate_detector(loaded, data, progress.update)
    if json_file is not None:
        scores = to_jsonable({"detector": loaded.info.name, "data": str(data.file), **asdict(found)})
        json_file.write_text(json.dumps(scores) + "\n")
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
    print_lines("AP50 of boxes: " + ", ".join(f"{name} {value:.3f}" for name, value in found.class_ap50.items()))
