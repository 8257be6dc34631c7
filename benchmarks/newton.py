"""Does the diagnosis name what was hidden in sequences of a simulator that is not ours? Cloth on pins, NVIDIA Newton.

    pip install -e '.[newton]'
    OMP_NUM_THREADS=1 python -m benchmarks.newton RESULTS.jsonl [--films newton-films]

289 vertices, 30 frames a second, 1 mm of noise; three motions, a held-out one, and two base ones with nothing hidden.
What the user believes is the challenge's square; Newton's elastic law is another one, and its damping is its time
step's. Resumes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro

from benchmarks._newton_cloth import FPS, Fabric, Force, NewtonCloth, Surface, accelerated, air, nothing, pressed
from caphy.challenge.sheets import corners, users_square
from caphy.challenge.square import APART, MODEL
from caphy.challenge.swings import BASE, HELD_OUT, TRAINING, Swing, about_vertical, pin_path
from caphy.diagnose.base import from_base
from caphy.diagnose.diagnosis import diagnose
from caphy.diagnose.figures import figures
from caphy.effects.registry import find_effect
from caphy.garment.template import Garment, read_npz, write_npz
from caphy.io.measurements import Measurement
from caphy.measure.scene import Scene
from caphy.refit.study import Study

FRAMES, CALM, RUN_UP = 48, 15, 15


@dataclass(frozen=True)
class Options:
    """What to run."""

    results: tyro.conf.Positional[Path]
    """JSON lines, one per case; made if it is not there."""
    films: Path = Path("newton-films")
    """Where simulations are kept."""
    only: tuple[str, ...] = ()
    """Cases; all unless given."""


@dataclass(frozen=True)
class Case:
    """What is hidden: its coefficients in the library's terms, and how Newton is told."""

    effects: dict[str, dict[str, Any]] = field(default_factory=dict)
    force: Callable[[Surface], Force] = lambda surface: nothing
    fabric: Fabric = field(default_factory=Fabric)


def _air(name: str, c: float, wind: tuple[float, float, float] | None, across: bool, power: int) -> Case:
    values: dict[str, Any] = {"coefficient": c}
    if wind is not None:
        values |= {"velocity": wind} if power == 2 else {"push": tuple(c * w for w in wind)}
    return Case({name: values}, lambda surface: air(surface, c, np.array(wind or (0, 0, 0)), across, power))


CASES: dict[str, Case] = {
    "nothing": Case(),
    "air_drag_normal": _air("air_drag_normal", 0.4, None, True, 1),
    "air_drag_normal_quadratic": _air("air_drag_normal_quadratic", 0.6, None, True, 2),
    "air_drag_tangential": _air("air_drag_tangential", 0.4, None, False, 1),
    "wind_normal": _air("wind_normal", 0.2, (0.9, 0.0, -0.6), True, 1),
    "wind_normal_quadratic": _air("wind_normal_quadratic", 0.4, (-0.7, 0.0, 0.8), True, 2),
    "uniform_acceleration": Case(
        {"uniform_acceleration": {"acceleration": (0.5, 0.0, -0.4)}},
        lambda surface: accelerated(Fabric().density * surface.share, np.array((0.5, 0.0, -0.4)), 0.0),
    ),
    "mass_damping": Case(
        {"mass_damping": {"rate": 1.5}},
        lambda surface: accelerated(Fabric().density * surface.share, np.zeros(3), 1.5),
    ),
    "pressure": Case({"pressure": {"pressure": 0.12}}, lambda surface: pressed(surface, 0.12)),
    "extra_bending": Case({"extra_bending": {"stiffness": 6e-5}}, fabric=Fabric(bending=1.2e-4)),
    "extra_mass": Case({"extra_mass": {"density": 0.07}}, fabric=Fabric(density=0.27)),
}
"""By name; an effect's coefficients are those of its file in ``caphy/effects``."""

MOTIONS: dict[str, tuple[Swing, ...]] = {"base": BASE, "train": TRAINING, "held_out": HELD_OUT}


def measured(case: str, part: str, films: Path) -> list[Measurement]:
    """The measurements of a case's part; films are kept, noise is added here."""
    cloth = users_square()
    found = []
    for number, swing in enumerate(MOTIONS[part]):
        name = f"{'nothing' if part == 'base' else case}-{part}-{number}"
        file = films / f"{name}.npz"
        if not file.is_file():
            write_npz(file, _played(cloth, CASES[case if part != "base" else "nothing"], swing, part, number))
        film = read_npz(file)
        noise = np.random.default_rng([ord(part[0]), number]).normal(0, 1e-3, film["positions"].shape)
        found.append(
            Measurement(
                name=name,
                fps=FPS,
                faces=cloth.faces,
                rest_vertices=cloth.vertices,
                material=cloth.material,
                noise_mm=1.0,
                vertices=film["positions"] + noise,
                pinned=corners(cloth),
                pinned_positions=film["pins"],
            )
        )
    return found


def _played(cloth: Garment, case: Case, swing: Swing, part: str, number: int) -> dict[str, np.ndarray]:
    """Positions and pins in each frame of a motion, after a rest and a run-up."""
    pins, since = corners(cloth), -(CALM + RUN_UP) / FPS
    hung = cloth.vertices * (APART, 1, 1)
    path = pin_path(swing, hung[pins], np.random.default_rng([7, ord(part[0]), number]), -RUN_UP / FPS)
    folded = hung + np.outer(0.01 * np.sin(25 * hung[:, 0] + 0.5), (0, 0, 1))
    folded = folded @ about_vertical(swing.facing).T
    folded[pins] = path(since)
    surface = Surface(cloth.vertices, cloth.faces)
    simulated = NewtonCloth(cloth.vertices, cloth.faces, pins, case.fabric)
    film = simulated.run(folded, path, since, (FRAMES - 1) / FPS, case.force(surface))[-FRAMES:]
    times = np.arange(FRAMES) / FPS
    return {"positions": film.astype(np.float32), "pins": np.stack([path(time) for time in times])}


def run(case: str, films: Path) -> dict:
    """One case: the answer, and what the diagnosis said."""
    scenes = [Scene.of(measurement) for measurement in measured(case, "base", films)]
    train, held_out = (measured(case, part, films) for part in ("train", "held_out"))
    began = time.process_time()
    base = from_base(Study(scenes), MODEL)
    told = figures(diagnose(MODEL, train, base, held_out))
    told["ranking"] = told["ranking"][:6]
    return {"case": case, "effects": CASES[case].effects, "cpu_seconds": time.process_time() - began, "diagnosis": told}


def family(found: list[str]) -> set[str]:
    """The groups that effects belong to."""
    return {find_effect(name).group for name in found}


def line(row: dict) -> str:
    """One case in a line."""
    d, best = row["diagnosis"], row["diagnosis"]["ranking"][0]
    held = d["held_out"]
    proof = "" if held is None else f"held out {held['before_mm']:.2f} -> {held['after_mm']:.2f} mm, "
    return (
        f"{row['case']:26s} {d['verdict']:14s} {','.join(d['found']) or '-':30s} best {best['explanation']} "
        f"{100 * best['gain']:.1f} % of {100 * d['gain_needed']:.1f}  {proof}"
        f"base {d['base']['median_mm']:.2f} mm  {row['cpu_seconds']:.0f} s"
    )


def table(rows: list[dict]) -> str:
    """The numbers of the goal."""
    some = [row for row in rows if row["effects"]]
    right = [row for row in some if set(row["diagnosis"]["found"]) == set(row["effects"])]
    kin = [row for row in some if family(row["diagnosis"]["found"]) == family(list(row["effects"]))]
    close = [strongest(row) for row in right]
    floor = [
        row["diagnosis"]["held_out"]["after_mm"] / row["diagnosis"]["base"]["median_mm"]
        for row in kin
        if row["diagnosis"]["held_out"]
    ]
    false = [row["case"] for row in rows if not row["effects"] and row["diagnosis"]["found"]]
    return "\n".join(
        [
            f"right family: {len(kin)} of {len(some)}",
            f"right law, nothing else: {len(right)} of {len(some)}",
            "strongest coefficient over the truth: " + ", ".join(f"{ratio:.2f}" for ratio in close),
            f"held-out median error over the base's, right families: {', '.join(f'{ratio:.2f}' for ratio in floor)}",
            f"named where nothing is hidden: {false or 'none'}",
        ]
    )


def strongest(row: dict) -> float:
    """The largest coefficient told over the true one."""
    ((name, values),) = row["effects"].items()
    told = row["diagnosis"]["coefficients"]
    pairs = []
    for key, value in values.items():
        for place, one in np.ndenumerate(np.asarray(value, dtype=float)):
            said = told.get(f"{name}.{key}" + (f"[{','.join(map(str, place))}]" if place else ""))
            if said is not None:
                pairs.append((abs(one), said["value"] / one if one else np.nan))
    return max(pairs)[1]


def main() -> None:
    """Run what is missing, then print the table."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    lines = options.results.read_text(encoding="utf-8").splitlines() if options.results.exists() else []
    rows = [json.loads(text) for text in lines]
    done = {row["case"] for row in rows}
    for case in options.only or CASES:
        if case not in done:
            rows.append(run(case, options.films))
            with options.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            print(line(rows[-1]), flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
