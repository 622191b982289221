"""Figures that others report, in one place with their sources, and which recordings they were measured on.

"The paper" is the one that semdb follows: coarse-to-fine localization with a database of semantic keyframes. Its
tables: 1 (frames), 2 (detector), 3 (accuracy per sequence), 4 (against learned poses); Figures 6 and 7 are curves.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

PAPER_METHOD = "the paper"
CHEN_METHOD = "Chen et al."
ICL_NUIM = "ICL-NUIM"
TUM_RGBD = "TUM RGB-D"


@dataclass(frozen=True, slots=True)
class PaperRow:
    """A row of the paper's Table 3: errors in metres and degrees, success 0..1; None where the paper gives none."""

    sequence: str
    raw_frames: int | None
    keyframes: int | None
    test_frames: int | None
    median_translation_m: float
    median_rotation_deg: float
    mean_translation_m: float
    mean_rotation_deg: float
    success_rate: float | None
    method: str = PAPER_METHOD

    @property
    def collection(self) -> str:
        """The data set that the sequence belongs to."""
        return ICL_NUIM if self.sequence.startswith(ICL_NUIM) else TUM_RGBD


# Tables 1 and 3 of the paper; the rows "all" are the paper's own averages. Chen et al. as the same Table 3 has them.
PAPER_TABLE_3 = (
    PaperRow("ICL-NUIM living room kt0", 1510, 70, 1000, 0.0096, 0.3265, 0.0607, 2.2212, 0.9170),
    PaperRow("ICL-NUIM living room kt1", 967, 36, 600, 0.0103, 0.2780, 0.0396, 0.9997, 0.9600),
    PaperRow("ICL-NUIM living room kt2", 882, 54, 500, 0.0097, 0.2612, 0.0395, 0.9361, 0.9987),
    PaperRow("ICL-NUIM living room kt3", 1242, 101, 800, 0.0088, 0.3142, 0.0317, 1.3179, 0.9575),
    PaperRow("ICL-NUIM office room kt0", 1510, 77, 1000, 0.0199, 0.4123, 0.1549, 3.1138, 0.8977),
    PaperRow("ICL-NUIM office room kt1", 967, 47, 600, 0.0091, 0.3193, 0.0462, 2.0639, 0.7794),
    PaperRow("ICL-NUIM office room kt2", 882, 54, 500, 0.0113, 0.2948, 0.0768, 1.5928, 0.9400),
    PaperRow("ICL-NUIM office room kt3", 1242, 45, 800, 0.0152, 0.4550, 0.0525, 1.5997, 0.8696),
    PaperRow("ICL-NUIM, all", None, None, None, 0.0118, 0.3327, 0.0628, 1.7307, 0.9150),
    PaperRow("TUM freiburg1_plant", 1120, 171, 800, 0.0179, 0.6079, 0.0678, 2.3161, 0.9329),
    PaperRow("TUM freiburg1_room", 1352, 243, 1000, 0.0141, 0.6978, 0.0768, 3.4290, 0.9243),
    PaperRow("TUM freiburg2_360_hemisphere", 2647, 800, 2000, 0.0797, 0.8259, 0.4790, 5.4154, 0.8965),
    PaperRow("TUM freiburg2_flowerbouquet", 2859, 323, 2000, 0.0138, 0.6443, 0.0295, 1.6028, 0.9612),
    PaperRow("TUM freiburg2_pioneer_slam3", 2224, 253, 1800, 0.0344, 0.6426, 0.2653, 3.7028, 0.8576),
    PaperRow("TUM freiburg3_long_office_household", 2486, 246, 2000, 0.0148, 0.5660, 0.0302, 1.0600, 0.9967),
    PaperRow("TUM RGB-D, all", None, None, None, 0.0291, 0.6641, 0.1581, 2.9210, 0.9282),
    PaperRow("ICL-NUIM, all", None, None, None, 0.06, 0.01, 0.34, 3.43, None, CHEN_METHOD),
    PaperRow("TUM RGB-D, all", None, None, None, 0.10, 0.16, 0.32, 5.58, None, CHEN_METHOD),
)
PAPER_SEQUENCES = {row.sequence: row for row in PAPER_TABLE_3 if row.test_frames is not None}


@dataclass(frozen=True, slots=True)
class MeanRow:
    """A row of the paper's Table 4: mean errors on ICL-NUIM, metres and degrees."""

    method: str
    living_translation_m: float
    living_rotation_deg: float
    office_translation_m: float
    office_rotation_deg: float


# Table 4 of the paper, which names the sources of the other methods. Poses regressed by networks trained per room.
PAPER_TABLE_4 = (
    MeanRow("PoseNet", 0.60, 3.64, 0.46, 2.97),
    MeanRow("4D PoseNet", 0.58, 3.40, 0.44, 2.81),
    MeanRow("CNN+LSTM", 0.54, 3.21, 0.41, 2.66),
    MeanRow(PAPER_METHOD, 0.04, 1.37, 0.08, 2.09),
)

# What the text to Figures 6 and 7 says: above 90 % of queries within 0.3 m, over 80 % within 2.5 degrees.
PAPER_TRANSLATION = (0.3, 0.9)
PAPER_ROTATION = (2.5, 0.8)

# Milliseconds per query on a TITAN Xp, as the paper reports them: finding the candidate frame, and the pose.
PAPER_TIMING_MS = {"candidate frame": 296.5, "pose": 277.9}

_TUM_NAMES = {row.sequence.removeprefix("TUM "): row for row in PAPER_SEQUENCES.values() if row.collection == TUM_RGBD}


def sequence_of(path: Path) -> PaperRow | None:
    """The row of Tables 1 and 3 that a folder holds, by its name and that of the folder around it; None for others.

    Known are the names of the downloads (``rgbd_dataset_freiburg1_plant``, ``living_room_traj0_frei_png``,
    ``traj0_frei_png``, which is the office; ``traj0n`` with noise as well) and usual short ones (``fr1_plant``,
    ``fr1/plant``, ``lr_kt0``, ``office_room/kt0``, ``icl_nuim_office_kt0``). A link may have the name, or what it
    leads to.
    """
    for folder in (Path(os.path.abspath(path)), path.resolve()):
        own, around = (re.sub(r"[-. /]+", "_", name.lower()).strip("_") for name in (folder.name, folder.parent.name))
        found = _tum_sequence(own, around) or _icl_sequence(own, around)
        if found is not None:
            return found
    return None


def _tum_sequence(own: str, around: str) -> PaperRow | None:
    if re.fullmatch(r"(tum_)?(fr|freiburg)[123]", around):
        own = f"{around}_{own}"
    short = re.sub(r"^(tum_)?(rgbd_dataset_)?", "", own)
    match = re.fullmatch(r"(?:fr|freiburg)([123])_(.+)", short)
    return None if match is None else _TUM_NAMES.get(f"freiburg{match.group(1)}_{match.group(2)}")


def _icl_sequence(own: str, around: str) -> PaperRow | None:
    end = r"(?:_?(?:kt|traj)_?)([0-3])n?(?:_frei_png|_png|_loop)?"
    living = r"(?:icl_?(?:nuim)?_)?(?:living_?room|living|lr)"
    office = r"(?:icl_?(?:nuim)?_)?(?:office_?room|office|of|or)"
    for room, words in (("living", living), ("office", office)):
        match = re.fullmatch(words + end, own)
        if match is None and re.fullmatch(words, around):
            match = re.fullmatch(end, own)
        if match is not None:
            return PAPER_SEQUENCES[f"{ICL_NUIM} {room} room kt{match.group(1)}"]
    match = re.fullmatch(r"traj([0-3])n?_frei_png", own)  # the downloads of the office do not name the room
    return None if match is None else PAPER_SEQUENCES[f"{ICL_NUIM} office room kt{match.group(1)}"]


@dataclass(frozen=True, slots=True)
class Counts:
    """Numbers of keyframes and of queries, and one line that says where they come from."""

    keyframes: int
    queries: int
    note: str


def counts_like(row: PaperRow, frames: int) -> Counts:
    """As many keyframes and queries as the paper has, in proportion where a copy has fewer frames than its sequence.

    `frames` are those that can be used. A copy with nearly all frames (at least nine in ten) is a whole one.
    """
    raw, keyframes, queries = row.raw_frames or 0, row.keyframes or 0, row.test_frames or 0
    if frames >= 0.9 * raw:
        note = f"is {row.sequence} of the paper: {keyframes} keyframes and {queries} queries as in its Table 1"
        if frames < keyframes + queries:  # its own test images must have been keyframes too
            note += f", of which {max(0, frames - keyframes)} are no keyframes and are asked"
        return Counts(keyframes, queries, note)
    share = frames / raw
    own_keyframes, own_queries = max(1, round(share * keyframes)), max(1, round(share * queries))
    note = (
        f"is {row.sequence} of the paper with {frames} of its {raw} frames: {own_keyframes} keyframes and at most "
        f"{own_queries} queries, in proportion to {keyframes} and {queries} of its Table 1"
    )
    return Counts(own_keyframes, own_queries, note)
