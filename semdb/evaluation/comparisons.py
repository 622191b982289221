"""Our rows beside those of the paper's Tables 1, 3 and 4."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from semdb.evaluation.averages import Average, averages, plain_mean
from semdb.evaluation.formats import NOTHING, errors, percent
from semdb.evaluation.methods import SEMDB
from semdb.evaluation.metrics import EvaluationResult
from semdb.evaluation.published import PAPER_SEQUENCES, PAPER_TABLE_3, PAPER_TABLE_4, PaperRow

REFINED_NOTE = " (refined poses)"
PAPER_HEADERS = ("sequence", "method", "frames", "keyframes", "queries", "median m / °", "mean m / °", "success")


@dataclass(frozen=True, slots=True)
class Grid:
    """A table as plain cells. `ours` are positions of rows that are results of this run, among those of others."""

    title: str
    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    note: str = ""
    text_columns: int = 2
    ours: frozenset[int] = frozenset()


def table_1(results: Sequence[EvaluationResult]) -> Grid:
    """Frames, keyframes and test images: of the paper's sequences, and of the recordings of this run."""
    rows: list[tuple[str, ...]] = [
        (row.sequence, "the paper", str(row.raw_frames), str(row.keyframes), str(row.test_frames))
        for row in PAPER_SEQUENCES.values()
    ]
    count = len(rows)
    seen = {
        (result.sequence or result.recording, result.frames, result.keyframes, result.queries) for result in results
    }
    rows += [(name, "this run", *map(str, counts)) for name, *counts in sorted(seen)]
    return Grid(
        "Table 1: frames, keyframes and test images",
        ("sequence", "", "frames", "keyframes", "queries"),
        rows,
        ours=frozenset(range(count, len(rows))),
    )


def table_3(results: Sequence[EvaluationResult], *, only_evaluated: bool = False) -> Grid:
    """Accuracy per sequence, each of ours below the paper's; then means; then what the paper does not have.

    With `only_evaluated`, without the sequences that this run does not have.
    """
    known = {result.sequence for result in results}
    rows: list[tuple[str, ...]] = []
    ours: set[int] = set()
    for row in (row for row in PAPER_TABLE_3 if row.test_frames is not None):
        if only_evaluated and row.sequence not in known:
            continue
        own = [_own_cells(result) for result in results if result.sequence == row.sequence]
        _add(rows, ours, [row], own)
    collections = {PAPER_SEQUENCES[name].collection for name in known if name in PAPER_SEQUENCES}
    for name in dict.fromkeys(row.sequence for row in PAPER_TABLE_3 if row.test_frames is None):
        whole = [row for row in PAPER_TABLE_3 if row.sequence == name]
        if only_evaluated and whole[0].collection not in collections:
            continue
        _add(rows, ours, whole, [_mean_cells(mean) for mean in averages(results) if mean.name == name])
    _add(rows, ours, [], [] if only_evaluated else [_own_cells(result) for result in results if not result.sequence])
    return Grid(
        "Table 3: accuracy",
        PAPER_HEADERS,
        rows,
        "Keyframes and queries from one sequence; median and mean over localized queries. A recording that is not "
        "among the paper's is another task: it shows the region, not a ranking. The paper gives Chen et al. as "
        "averages only.",
        ours=frozenset(ours),
    )


def _add(
    rows: list[tuple[str, ...]], ours: set[int], published: Sequence[PaperRow], own: Sequence[tuple[str, ...]]
) -> None:
    """Published rows with our own below, whose positions go into `ours`."""
    rows += [_paper_cells(row) for row in published]
    ours |= set(range(len(rows), len(rows) + len(own)))
    rows += own


def paper_rows_evaluated(results: Sequence[EvaluationResult]) -> Grid:
    """`table_3` for the terminal: the paper's sequences that were evaluated; no rows where there is none."""
    if not any(result.sequence for result in results):
        return Grid("", PAPER_HEADERS, [])
    return table_3(results, only_evaluated=True)


def table_4(results: Sequence[EvaluationResult]) -> Grid:
    """Mean errors on the rooms of ICL-NUIM beside poses regressed by networks; ours where its sequences were run."""
    rows: list[tuple[str, ...]] = [
        (row.method, errors(row.living_translation_m, row.living_rotation_deg),
         errors(row.office_translation_m, row.office_rotation_deg), NOTHING, NOTHING)
        for row in PAPER_TABLE_4
    ]  # fmt: skip
    count = len(rows)
    kinds = dict.fromkeys(_kind(result) for result in results if "ICL-NUIM" in (result.sequence or ""))
    for method, truth, asked in kinds:
        alike = [result for result in results if _kind(result) == (method, truth, asked)]
        name = f"{method}{REFINED_NOTE if truth == 'refined' else ''}, this run"
        name += "" if asked is None else f", {asked} keyframes each"
        cells = [_room_mean(alike, room, of) for of in ("mean", "median") for room in ("living", "office")]
        rows.append((name, *cells))
    note = (
        "Networks that regress a pose, trained on each room; mean over the four sequences of each room. The paper has "
        "no medians."
    )
    if not kinds:
        note += " This run has no sequence of ICL-NUIM."
    return Grid(
        "Table 4: error on ICL-NUIM, m / °",
        ("method", "living room, mean", "office room, mean", "living room, median", "office room, median"),
        rows,
        note,
        text_columns=1,
        ours=frozenset(range(count, len(rows))),
    )


def regression_grid(results: Sequence[EvaluationResult]) -> Grid:
    """Networks that regress poses beside what uses structure, on the recordings of this run; none without networks.

    The factor is that of mean position errors over those of `semdb` on the same queries and keyframes.
    """
    rows = []
    learnt = {_same_queries(result) for result in results if result.training_frames is not None}
    structure = {_same_queries(result): result.mean_translation_m for result in results if result.method == SEMDB}
    for result in results:
        where = _same_queries(result)
        if where not in learnt:
            continue
        best, own = structure.get(where), result.mean_translation_m
        rows.append((
            result.recording,
            result.method + (REFINED_NOTE if result.truth == "refined" else ""),
            str(result.keyframes),
            NOTHING if result.training_frames is None else str(result.training_frames),
            errors(result.mean_translation_m, result.mean_rotation_deg),
            errors(result.median_translation_m, result.median_rotation_deg),
            percent(result.recall["0.3m"]),
            NOTHING if not best or own is None else f"{own / best:.1f}",
        ))  # fmt: skip
    return Grid(
        "Table 4 on the recordings of this run",
        ("recording", "method", "keyframes", "learnt from", "mean m / °", "median m / °", "0.3 m", "times semdb"),
        rows,
        "Means and medians over localized queries; networks and fixed poses always answer. The last column is the mean "
        "position error over that of semdb.",
        ours=frozenset(range(len(rows))),
    )


def _same_queries(result: EvaluationResult) -> tuple[str, str, int, int]:
    """What results on the same queries and keyframes have in common."""
    return result.recording, result.truth, result.keyframes, result.queries


def _kind(result: EvaluationResult) -> tuple[str, str, int | None]:
    """What must be the same in results that are averaged."""
    return result.method, result.truth, result.keyframes_asked


def _room_mean(results: Sequence[EvaluationResult], room: str, of: str) -> str:
    chosen = [result for result in results if f"ICL-NUIM {room}" in (result.sequence or "")]
    number = len({result.sequence for result in chosen})
    mean = errors(
        plain_mean(getattr(result, f"{of}_translation_m") for result in chosen),
        plain_mean(getattr(result, f"{of}_rotation_deg") for result in chosen),
    )
    return mean if number in (0, 4) else f"{mean} ({number} of 4)"


def _paper_cells(row: PaperRow) -> tuple[str, ...]:
    return (
        row.sequence,
        row.method,
        *(NOTHING if count is None else str(count) for count in (row.raw_frames, row.keyframes, row.test_frames)),
        errors(row.median_translation_m, row.median_rotation_deg),
        errors(row.mean_translation_m, row.mean_rotation_deg),
        percent(row.success_rate),
    )


def _own_cells(result: EvaluationResult) -> tuple[str, ...]:
    return (
        result.sequence or result.recording,
        result.method + (REFINED_NOTE if result.truth == "refined" else ""),
        str(result.frames),
        str(result.keyframes),
        str(result.queries),
        errors(result.median_translation_m, result.median_rotation_deg),
        errors(result.mean_translation_m, result.mean_rotation_deg),
        percent(result.success_rate),
    )


def _mean_cells(mean: Average) -> tuple[str, ...]:
    return (
        f"{mean.name.removesuffix(', all')}, mean of {mean.sequences}",
        mean.method + (REFINED_NOTE if mean.truth == "refined" else ""),
        NOTHING,
        str(mean.keyframes),
        str(mean.queries),
        errors(mean.median_translation_m, mean.median_rotation_deg),
        errors(mean.mean_translation_m, mean.mean_rotation_deg),
        percent(mean.success_rate),
    )
