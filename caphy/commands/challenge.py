"""``caphy challenge new|reveal``: measurements with a hidden effect, and the sealed answer."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from caphy.commands.compare import Progress
from caphy.commands.following import following
from caphy.commands.output import OUTPUT
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.io.places import writable_folder, write_text

if TYPE_CHECKING:
    from caphy.challenge.world import World


@dataclass(frozen=True)
class New:
    """Simulate measurements with something hidden in them: an effect, two, a force of no effect, or nothing."""

    seed: int
    """What is hidden, how strongly, the motions and the noise all follow from it."""
    output: Annotated[Path, OUTPUT]
    """Folder for model.json, train_*.npz, base_*.npz, held_out_*.npz and the sealed answer."""
    scene: Literal["square", "skirt", "tshirt"] = "square"
    """What is measured: a square of cloth shaken by two corners, or a garment on a moving body."""
    noise: float = 1.0
    """Standard deviation of each measured coordinate [mm]."""
    points: int | None = None
    """Points in each frame's cloud, 50 or more; without it the cloth's vertices are measured."""


@dataclass(frozen=True)
class Reveal:
    """Open the sealed answer, and hold the diagnosis against it if there is one."""

    folder: tyro.conf.Positional[Path]
    """The challenge's folder."""


def main(arguments: list[str]) -> None:
    """Run ``caphy challenge`` with the arguments after it."""
    command = tyro.extras.subcommand_cli_from_dict(
        {"new": New, "reveal": Reveal}, args=arguments, prog="caphy challenge"
    )
    if isinstance(command, New):
        new(command)
    else:
        reveal(command)


def new(command: New) -> None:
    """Make a challenge."""
    import numpy as np

    from caphy.challenge.hidden import HIDDEN
    from caphy.challenge.sealed import NAME
    from caphy.challenge.world import make
    from caphy.measure.track import FEWEST
    from caphy.processes import cores

    if not 0 <= command.noise < float("inf") or command.seed < 0:
        raise CaphyError(f"seed and noise must not be negative, got {command.seed} and {command.noise}")
    if command.points is not None and command.points < FEWEST:
        raise CaphyError(
            f"--points must be {FEWEST} or more, without which a frame counts as missing, got {command.points}"
        )
    writable_folder(command.output)
    if (command.output / "model.json").exists() and not (command.output / NAME).exists():
        raise CaphyError(f"{command.output}: holds a model.json that is no challenge's and would be replaced")
    if (command.output / "diagnosis").exists() and not _is_there(command):
        raise CaphyError(
            f"{command.output / 'diagnosis'}: belongs to another challenge, and 'caphy challenge reveal' would "
            "judge it by this one; choose another folder, or remove it"
        )
    names = sorted(name for name, hidden in HIDDEN.items() if hidden.acts_in(command.scene))
    hidden = HIDDEN[names[int(np.random.default_rng([command.seed, 7]).integers(len(names)))]]
    with unfinished(command.output / UNFINISHED) as films:
        with Progress("simulating", "motion") as progress:
            world = make(
                command.scene,
                hidden,
                command.seed,
                noise_mm=command.noise,
                points=command.points,
                cache=films,
                processes=cores(),
                progress=lambda done, total: progress("motions", done, total),
            )
        _written(command, world)


def _written(command: New, world: World) -> None:
    """Write a challenge, and say what comes next."""
    from caphy.challenge.sealed import NAME, sealed_in
    from caphy.io.measurements import write_measurement

    command.output.mkdir(parents=True, exist_ok=True)
    parts = {"train": world.train, "base": world.base, "held_out": world.held_out}
    paths: dict[str, list[str]] = {part: [] for part in parts}
    for part, measurements in parts.items():
        for number, measurement in enumerate(measurements):
            path = command.output / f"{part}_{number}.npz"
            write_measurement(measurement, path)
            paths[part].append(str(path))
    digest = sealed_in(command.output, world.answer)  # first: without it the model would be taken for one's own
    write_text(command.output / "model.json", world.model.to_json())
    files = [path for found in paths.values() for path in found]
    print("\n".join(map(str, [command.output / "model.json", *files, command.output / NAME])))
    print(f"sealed answer, SHA-256 {digest}")
    asked = ["--base", *paths["base"], "--held-out", *paths["held_out"], "-o", command.output / "diagnosis"]
    print(f"next: {following('diagnose', command.output / 'model.json', *paths['train'], *asked)}")
    print(f"then: {following('challenge', 'reveal', command.output)}")


def _is_there(command: New) -> bool:
    """Whether a folder holds the very challenge that is to be made, whose diagnosis may go on."""
    from caphy.challenge.sealed import opened

    try:
        answer, _ = opened(command.output)
    except CaphyError:
        return False
    wanted = {"seed": command.seed, "scene": command.scene, "noise_mm": command.noise, "points": command.points}
    return all(answer.get(key) == value for key, value in wanted.items())


def reveal(command: Reveal) -> None:
    """Open the answer."""
    from caphy.challenge.sealed import opened

    answer, digest = opened(command.folder)
    effects = answer["effects"] or {}
    print(f"sealed answer, SHA-256 {digest}: the one that was printed when the challenge was made?")
    print(f"hidden: {answer['hidden']}")
    for name, values in effects.items():
        print(f"  {name}: " + ", ".join(f"{key} {_short(value)}" for key, value in values.items()))
    if answer["outside"]:
        print(f"  a force of no effect: {answer['outside']}")
    told = command.folder / "diagnosis" / "diagnosis.json"
    if not told.exists():
        print(f"there is no diagnosis in {told.parent} to hold against it")
        return
    try:
        diagnosis = json.loads(told.read_text(encoding="utf-8"))
        named = ", ".join([diagnosis["verdict"], *diagnosis["found"]])
        judged = verdict(answer, diagnosis)
    except (ValueError, KeyError, TypeError) as error:
        raise CaphyError(f"{told}: is no diagnosis of such measurements; run 'caphy diagnose' again") from error
    print(f"diagnosis: {named}\n  {judged}")


def verdict(answer: dict, diagnosis: dict) -> str:
    """How a diagnosis compares with the truth, in words."""
    hidden, found = set(answer["effects"]), set(diagnosis["found"])
    if not hidden:
        return "right" if diagnosis["verdict"] == answer["verdict"] else "wrong"
    if found == hidden:
        return "right"
    alike = {name: {name, *answer["alike"].get(name, ())} for name in hidden}
    if all(found & names for names in alike.values()) and found <= set().union(*alike.values()):
        return "near: what was named moves the cloth much like what was hidden"
    missed = ", ".join(sorted(hidden - found)) or "nothing"
    return f"wrong: missed {missed}; named without reason: {', '.join(sorted(found - hidden)) or 'nothing'}"


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
