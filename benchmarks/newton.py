"""Does the diagnosis name what was hidden in sequences of a simulator that is not ours, NVIDIA Newton's VBD?

    pip install -e '.[newton]'
    OMP_NUM_THREADS=1 python -m benchmarks.newton RESULTS.jsonl [--scene tshirt] [--films newton-films]

Cloth on pins (289 vertices; three motions, two held out, two base ones with nothing hidden), or a T-shirt on a body
(1,312 vertices; two motions, one held out, one base); 30 frames a second, 1 mm of noise. What the user believes are the
challenge's models, for the T-shirt with friction; Newton's elastic law and contact are others, and its damping is its
time step's. Resumes.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

from benchmarks._newton_cloth import FPS, Fabric, Force, NewtonCloth, Skin, Surface, accelerated, air, nothing, pressed
from caphy.challenge.dressed import WORN, tshirt
from caphy.challenge.recording import mesh_digest, seen_by_user
from caphy.challenge.sheets import corners, users_square
from caphy.challenge.square import APART, MODEL
from caphy.challenge.stage import Play
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
FRICTION = 0.1
"""Between T-shirt and body, as the user knows."""
SEED = 51
"""Of the T-shirt's motions."""


@dataclass(frozen=True)
class Options:
    """What to run."""

    results: tyro.conf.Positional[Path]
    """JSON lines, one per case; made if it is not there."""
    films: Path = Path("newton-films")
    """Where simulations are kept."""
    scene: Literal["pins", "tshirt"] = "pins"
    """What is filmed."""
    only: tuple[str, ...] = ()
    """Cases; all of the scene unless given."""


@dataclass(frozen=True)
class Case:
    """What is hidden: its coefficients in the library's terms, and how Newton is told. Friction is the model's own."""

    effects: dict[str, dict[str, Any]] = field(default_factory=dict)
    force: Callable[[Surface], Force] = lambda surface: nothing
    fabric: Fabric = field(default_factory=Fabric)
    friction: float = FRICTION


def _air(name: str, c: float, wind: tuple[float, float, float] | None, across: bool, power: int) -> Case:
    values: dict[str, Any] = {"coefficient": c}
    if wind is not None:
        values |= {"velocity": wind} if power == 2 else {"push": tuple(c * w for w in wind)}
    return Case({name: values}, lambda surface: air(surface, c, np.array(wind or (0, 0, 0)), across, power))


def _accelerated(a: tuple[float, float, float]) -> Case:
    return Case(
        {"uniform_acceleration": {"acceleration": a}},
        lambda surface: accelerated(Fabric().density * surface.share, np.array(a), 0.0),
    )


def _damped(rate: float) -> Case:
    return Case(
        {"mass_damping": {"rate": rate}},
        lambda surface: accelerated(Fabric().density * surface.share, np.zeros(3), rate),
    )


CASES: dict[str, Case] = {
    "nothing": Case(),
    "air_drag_normal": _air("air_drag_normal", 0.4, None, True, 1),
    "air_drag_normal_quadratic": _air("air_drag_normal_quadratic", 0.6, None, True, 2),
    "air_drag_tangential": _air("air_drag_tangential", 0.4, None, False, 1),
    "wind_normal": _air("wind_normal", 0.2, (0.9, 0.0, -0.6), True, 1),
    "wind_normal_quadratic": _air("wind_normal_quadratic", 0.4, (-0.7, 0.0, 0.8), True, 2),
    "uniform_acceleration": _accelerated((0.5, 0.0, -0.4)),
    "mass_damping": _damped(1.5),
    "pressure": Case({"pressure": {"pressure": 0.12}}, lambda surface: pressed(surface, 0.12)),
    "extra_bending": Case({"extra_bending": {"stiffness": 6e-5}}, fabric=Fabric(bending=1.2e-4)),
    "extra_mass": Case({"extra_mass": {"density": 0.07}}, fabric=Fabric(density=0.27)),
}
"""By name; an effect's coefficients are those of its file in ``caphy/effects``."""

ON_BODY: dict[str, Case] = {
    "nothing": Case(),
    "air_drag_normal": _air("air_drag_normal", 1.5, None, True, 1),
    "wind_normal": _air("wind_normal", 0.5, (1.2, 0.0, -0.8), True, 1),
    "body_friction": Case({"body_friction": {"coefficient": 5 * FRICTION}}, friction=5 * FRICTION),
    "uniform_acceleration": _accelerated((1.6, 0.0, -1.2)),
    "pressure": Case({"pressure": {"pressure": 0.4}}, lambda surface: pressed(surface, 0.4)),
    "mass_damping": _damped(1.2),
}
"""The same for a T-shirt, which they move by centimetres, but for the last one."""

SCENES = {"pins": CASES, "tshirt": ON_BODY}

MOTIONS: dict[str, tuple[Swing, ...]] = {"base": BASE, "train": TRAINING, "held_out": HELD_OUT}


def measured_on_pins(case: str, part: str, films: Path) -> list[Measurement]:
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


def measured_on_body(case: str, part: str, films: Path) -> list[Measurement]:
    """The same of a T-shirt on a body, whose motions are the challenge's."""
    stage, found = tshirt(SEED, FRAMES, True), []
    plays = [play for play in stage.plays if play.part == part]
    for play in plays[: 2 if part == "train" else 1]:
        name = f"tshirt-{'nothing' if part == 'base' else case}-{part}-{play.number}"
        file = films / f"{name}-{mesh_digest(stage.user)[:8]}.npz"
        if not file.is_file():
            hidden = ON_BODY["nothing" if part == "base" else case]
            write_npz(file, {"positions": _worn(stage.user, hidden, play).astype(np.float32)})
        random = np.random.default_rng([SEED, ord(part[0]), play.number])
        found.append(seen_by_user(stage, play, read_npz(file)["positions"].astype(float), 1.0, None, random))
    return found


def _worn(shirt: Garment, case: Case, play: Play) -> np.ndarray:
    """Positions (T, V, 3) [m] in each frame of a play, after the way there from the T-pose."""
    body, ahead = play.drive.body, play.drive.ahead
    assert body is not None
    distance = find_effect("body_contact").parameters["distance"].default
    skin = Skin(body.faces, lambda time: body.at(time + ahead), float(distance), case.friction)
    simulated = NewtonCloth(shirt.vertices, shirt.faces, np.zeros(0, int), case.fabric, skin)
    surface = Surface(shirt.vertices, shirt.faces)
    until = (FRAMES - 1) / FPS
    return simulated.run(play.start.x.numpy(), None, play.start.time, until, case.force(surface))[-FRAMES:]


def run(scene: str, case: str, films: Path) -> dict:
    """One case: the answer, and what the diagnosis said."""
    measured = measured_on_pins if scene == "pins" else measured_on_body
    model = MODEL if scene == "pins" else WORN.with_effect("body_friction", coefficient=FRICTION)
    train, held_out, trusted = (measured(case, part, films) for part in ("train", "held_out", "base"))
    began = time.process_time()
    base = from_base(Study([Scene.of(measurement) for measurement in trusted]), model)
    told = figures(diagnose(model, train, base, held_out))
    told["ranking"] = told["ranking"][:6]
    return {"scene": scene, "case": case, "effects": SCENES[scene][case].effects,
            "cpu_seconds": time.process_time() - began, "diagnosis": told}  # fmt: skip


def family(found: Iterable[str]) -> set[str]:
    """The groups that effects belong to."""
    return {find_effect(name).group for name in found}


def line(row: dict) -> str:
    """One case in a line."""
    d, best = row["diagnosis"], row["diagnosis"]["ranking"][0]
    held = d["held_out"]
    proof = "" if held is None else f"held out {held['before_mm']:.2f} -> {held['after_mm']:.2f} mm, "
    return (
        f"{row['case']:26s} {d['verdict']:14s} {','.join(d['groups']) or '-':30s} best {best['explanation']} "
        f"{100 * best['gain']:.1f} % of {100 * d['gain_needed']:.1f}  {proof}"
        f"base {d['base']['median_mm']:.2f} mm  {row['cpu_seconds']:.0f} s"
    )


def table(rows: list[dict]) -> str:
    """The numbers of the goal."""
    some = [row for row in rows if row["effects"]]
    right = [row for row in some if set(row["diagnosis"]["groups"]) == set(row["effects"])]
    kin = [row for row in some if family(row["diagnosis"]["groups"]) == family(row["effects"])]
    close = [strongest(row) for row in right]
    floor = [
        row["diagnosis"]["held_out"]["after_mm"] / row["diagnosis"]["base"]["median_mm"]
        for row in kin
        if row["diagnosis"]["held_out"]
    ]
    false = [row["case"] for row in rows if not row["effects"] and row["diagnosis"]["groups"]]
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
                found = FRICTION * (1 + said["value"]) if name == "body_friction" else said["value"]
                pairs.append((abs(one), found / one if one else np.nan))
    return max(pairs)[1]


def main() -> None:
    """Run what is missing, then print the table."""
    options = tyro.cli(Options)
    torch.set_num_threads(1)
    lines = options.results.read_text(encoding="utf-8").splitlines() if options.results.exists() else []
    rows = [json.loads(text) for text in lines]
    done = {(row["scene"], row["case"]) for row in rows}
    for case in options.only or SCENES[options.scene]:
        if (options.scene, case) not in done:
            rows.append(run(options.scene, case, options.films))
            with options.results.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
            print(line(rows[-1]), flush=True)
    print(table([row for row in rows if row["scene"] == options.scene]))


if __name__ == "__main__":
    main()
