"""Where a query's depth fits into a map: alignments from several starts, and what else fits nearly as well."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from semdb.localization.surface_alignment import (
    PlacedSurfaces,
    Round,
    SurfaceFit,
    SurfaceOptions,
    distinct,
    fit_surfaces,
)
from semdb.localization.surfaces import Surfaces
from semdb.types import FloatArray

Near = Callable[[FloatArray], Sequence[PlacedSurfaces]]  # surfaces of the keyframes near a pose, nearest first


def search_surfaces(
    query: Surfaces, starts: Sequence[FloatArray], near: Near, options: SurfaceOptions
) -> list[SurfaceFit]:
    """Poses at which `query` lies well on surfaces of keyframes, from any of `starts` ``[4, 4]``, best score first.

    No two are the same; at most `finished` of the options. What lies far worse than the best after coarse rounds stays
    where these left it, since no fine ones would bring it near, and is measured as the others are.
    """
    first, *others = ((one,) for one in options.coarse)
    fits = [fit_surfaces(query, near(start), start, first, options) for start in starts]
    for rounds in others:
        fits = [_from(query, fit, near, rounds, options) for fit in _best(fits)[: options.followed]]
    coarse, fine = _best(fits), list[SurfaceFit | None]()
    as_it_lies = (replace(options.fine[-1], steps=0),)
    for fit in coarse[: options.finished]:
        far = fit.score < coarse[0].score - options.far_less
        fine.append(_from(query, fit, near, as_it_lies if far else options.fine, options))
    return _best(fine)


def _from(
    query: Surfaces, fit: SurfaceFit, near: Near, rounds: Sequence[Round], options: SurfaceOptions
) -> SurfaceFit | None:
    """What further rounds make of a pose."""
    pose = fit.world_from_camera
    return fit_surfaces(query, near(pose), pose, rounds, options)


def _best(fits: Sequence[SurfaceFit | None]) -> list[SurfaceFit]:
    """One of each pose, best score first."""
    return [group[0] for group in distinct([fit for fit in fits if fit is not None])]
