"""Is a planted fabric found in scans of cloth at rest, from a wrong start, and what does noise do to each objective?

    OMP_NUM_THREADS=1 python -m benchmarks.fabric [--count 60] [--sweep 6]

A panel of 30 cm hangs between two bars of a frame that is turned at random. The truth is the solver's on a finer mesh
than the fit's, of a fabric that the fit does not know; scans are points at random on it, 6 mm apart, with noise.
Contact, visibility and errors of the body have no part in it; worn clothes are not measured.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro

from benchmarks._panel import Stills, panel, turns
from caphy.capture.subject import Fabric
from caphy.effects.model import Model
from caphy.effects.presets import fabric_model
from caphy.fabric.certainty import Certainty
from caphy.fabric.coefficients import Coefficients
from caphy.fabric.rounds import Fitted, Objective, fit_fabric, ratios
from caphy.garment.subdivision import Subdivision
from caphy.garment.template import Garment
from caphy.material.fabrics import fabric


@dataclass(frozen=True)
class Options:
    """Plant, scan, fit, compare."""

    count: int = 60
    """Scans of the panel."""
    noise: float = 0.001
    """Of each coordinate of their points, one standard deviation [m]."""
    sweep: int = 6
    """Scans used at each noise of the table by both objectives; 0 leaves it out."""
    rounds: int = 8
    corrections: int = 1
    """Times that the mesh's error is told."""
    planted: str = "white-swim-solid"
    """The measured fabric that the truth is made of, and factors on it (the virtual rig draws such factors too):"""
    stretch: float = 1.0
    bend: float = 2.0
    density: float = 1.25
    start: str = "gray-interlock"
    fine: int = 21
    """Rows of vertices of the truth, and of the fit:"""
    coarse: int = 10
    seed: int = 1
    stills: Path | None = None
    """Where the truth is kept for another run (.npz)."""
    page: Path | None = None
    """Where to draw the curves of start, found and true fabric (.html)."""


def main(options: Options) -> None:
    """Print recovery, and the table of noise."""
    known = fabric(options.planted)
    planted = Fabric(known.name, options.stretch, options.bend, options.density * known.density).model
    start = replace(fabric_model(options.start), density=planted.density)
    stills = Stills(planted, options.fine, turns(options.count, options.seed), options.seed, options.stills)
    coarse = panel(options.coarse)
    print(
        f"{options.count} stills of {options.planted} (stretching x {options.stretch:g}, bending x {options.bend:g}, "
        f"density x {options.density:g}) on {len(stills.truth.vertices)} vertices; fitted on "
        f"{len(coarse.vertices)}, the mesh's error told by {len(Subdivision.of(coarse).garment.vertices)}",
        flush=True,
    )
    fitted = _print_recovery(options, stills, planted, start)
    if options.page is not None:
        from caphy.fabric.curves import figures, page

        plots = figures({"start": start, "found": fitted.model, "true": planted})
        options.page.write_text(page({"panel": plots}, {"panel": []}), encoding="utf-8")
    if options.sweep:
        print(f"found over true, {options.sweep} scans, from {options.start}, the mesh's error left in:")
        _print_sweep(options, stills, coarse, planted, start)
        print(f"the same from {options.planted} itself, on the truth's own mesh:")
        _print_sweep(options, stills, stills.truth, planted, planted)


def _print_recovery(options: Options, stills: Stills, planted: Model, start: Model) -> Fitted:
    spent = time.process_time()
    scans = stills.scans(panel(options.coarse), options.noise)
    fitted = fit_fabric(scans, start, options.rounds, corrections=options.corrections)
    for number, one in enumerate(fitted.rounds):
        told = ratios(fitted.numbers, fitted.energy, one.values, Coefficients.of(planted).values)
        shown = ", ".join(f"{name} {value:.3f}" for name, value in told.items())
        print(f"  round {number + 1}: {shown}{', mesh corrected' if one.corrected else ''}")
    spent = time.process_time() - spent
    sure = Certainty.of(fitted)
    before = over_truth(fitted, planted, fitted.numbers.values)
    print(
        f"from {options.start}, noise {1e3 * options.noise:g} mm, {len(fitted.rounds)} rounds, {spent:.0f} s of a core"
    )
    for name, found in over_truth(fitted, planted, fitted.values).items():
        scale = found / fitted.stiffness[name]
        said = f"{scale * sure.low[name]:.2f} to {scale * sure.high[name]:.2f}"
        print(
            f"  {name:17s} start {before[name]:.2f} of the truth, found {found:.3f} (95 %: {said})"
            f"{'' if sure.determined[name] else ', not determined'}"
        )
    return fitted


def _print_sweep(options: Options, stills: Stills, garment: Garment, planted: Model, start: Model) -> None:
    print("  noise [mm]   response: stretching bending   force (E_param): stretching bending")
    for noise in (0.0, 0.001, 0.002):
        scans = stills.scans(garment, noise)[: options.sweep]
        cells = []
        objectives: tuple[Objective, ...] = ("response", "force")
        for objective in objectives:
            fitted = fit_fabric(scans, start, options.rounds, objective, corrections=0)
            cells += over_truth(fitted, planted, fitted.values).values()
        print(f"  {1e3 * noise:10.1f} {cells[0]:22.2f} {cells[1]:7.2f} {cells[2]:29.2f} {cells[3]:7.2f}", flush=True)


def over_truth(fitted: Fitted, planted: Model, values: np.ndarray) -> dict[str, float]:
    """Energies that values (K,) store in the scans over those that the true tables do, effect -> ratio.

    Of the true ones too small entries are raised.
    """
    return ratios(fitted.numbers, fitted.energy, values, Coefficients.of(planted).values)


if __name__ == "__main__":
    main(tyro.cli(Options))
