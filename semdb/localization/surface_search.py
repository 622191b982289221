"""Where a query's depth fits into a map: alignments from several starts, and what else fits nearly as well."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from semdb.localization.surface_alignment import PlacedSurfaces, SurfaceFit, SurfaceOptions, distinct, fit_surfaces
from semdb.localization.surfaces import Surfaces
from semdb.types import FloatArray

Near = Callable[[FloatArray], Sequence[PlacedSurfaces]]  # surfaces of the keyframes near a pose, nearest first


def search_surfaces(
    query: Surfaces, starts: Sequence[FloatArray], near: Near, options: SurfaceOptions
) -> list[SurfaceFit]:
    """Poses at which `query` lies well on surfaces of keyframes, from any of `starts` ``[4, 4]``, best score first.

    No two are the same; at most `finished` of the options.
    """
    coarse = [fit_surfaces(query, near(start), start, options.coarse, options) for start in starts]
    groups = distinct([fit for fit in coarse if fit is not None])
    fine = []
    for group in groups[: options.finished]:
        pose = group[0].world_from_camera
        fit = fit_surfaces(query, near(pose), pose, options.fine, options)
        if fit is not None:
            fine.append(fit)
    return [group[0] for group in distinct(fine)]
