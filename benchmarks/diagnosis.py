"""Does the diagnosis name what was hidden? Every case of the challenge, and a table with every failure listed.

    OMP_NUM_THREADS=1 python -m benchmarks.diagnosis RESULTS.jsonl [--seeds 3] [--scenes square skirt] [--minutes 60]

Resumes: cases that RESULTS.jsonl holds are not run again. Truths come from the challenge's own explicit simulator on
another mesh; a base sequence, in which nothing is hidden, is given to every case.
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro

from caphy.challenge.hidden import HIDDEN, NOTHING, ONE, OUTSIDE, PAIRS
from caphy.challenge.world import World, make
from caphy.io.places import write_text
from caphy.processes import end_at_ctrl_c


@dataclass(frozen=True)
class Options:
    """What to run."""

    results: tyro.conf.Positional[Path]
    """JSON lines, one per case; made if it is not there."""
    scenes: tuple[str, ...] = ("square",)
    """Scenes of the challenge."""
    seeds: int = 1
    """Motions, strengths and noises: how many seeds."""
    first: int = 1
    """The first of these seeds."""
    noise_mm: float = 1.0
    """Standard deviation of each coordinate [mm]."""
    points: int | None = None
    """Of each frame's cloud; registered vertices unless given."""
    wrong: float = 0.0
    """Share by which the user's stiffnesses are off, up and down in turn."""
    only: tuple[str, ...] = ()
    """Names of what is hidden; everything unless given."""
    workers: int = 2
    """Processes."""
    minutes: float = 1e9
    """No case is begun after that."""
    cache: Path = Path("challenge-cache")
    """Where simulations are kept."""


Case = tuple[str, str, str, int]
"""Kind, scene, name of what is hidden, seed."""


def cases(options: Options) -> list[Case]:
    """All cases, kinds mixed so that a run cut short says something of each."""
    kinds = {"none": list(NOTHING), "outside": list(OUTSIDE), "pair": list(PAIRS)}
    every: list[Case] = []
    for seed in range(options.first, options.first + options.seeds):
        for scene in options.scenes:
            singles = [("one", scene, name, seed) for name in ONE if _wanted(name, scene, options)]
            others = [(k, scene, name, seed) for k, names in kinds.items() for name in names
                      if _wanted(name, scene, options)]  # fmt: skip
            stride = max(len(singles) // max(len(others), 1), 1)
            while singles or others:
                every += singles[:stride]
                every += others[:1]
                singles, others = singles[stride:], others[1:]
    return every


def _wanted(name: str, scene: str, options: Options) -> bool:
    return HIDDEN[name].acts_in(scene) and (not options.only or name in options.only)


def run(case: Case, options: Options) -> dict:
    """One case: its answer and how it compares with the truth."""
    from caphy.diagnose.base import from_base
    from caphy.diagnose.diagnosis import diagnose
    from caphy.diagnose.figures import figures
    from caphy.measure.scene import Scene
    from caphy.measure.track import registered
    from caphy.refit.study import Study

    torch.set_num_threads(1)
    kind, scene, name, seed = case
    hidden = HIDDEN[name]
    noise_mm, points, wrong = options.noise_mm, options.points, options.wrong
    world = make(scene, hidden, seed, noise_mm=noise_mm, points=points, wrong=wrong, cache=options.cache)
    began = time.process_time()
    key = (scene, seed, noise_mm, points, wrong, hidden.same_mesh)
    if key not in _BASES:
        scenes = [registered(Scene.of(measurement), world.model) for measurement in world.base]
        _BASES[key] = from_base(Study(scenes), world.model)
    learned = time.process_time() - began
    began = time.process_time()
    diagnosis = diagnose(world.model, world.train, _BASES[key], world.held_out)
    seconds = {"diagnosis": time.process_time() - began, "base": learned}
    told = figures(diagnosis)
    told["ranking"] = told["ranking"][:3]
    told["base"].pop("correction")
    if kind in ("one", "pair") and not wrong:
        told["truth_held_out_mm"] = _truth_held_out(world)
    return {"kind": kind, "scene": scene, "hidden": name, "seed": seed, "noise_mm": noise_mm, "points": points,
            "wrong": wrong, "cpu_seconds": seconds, "answer": dict(world.answer), "diagnosis": told}  # fmt: skip


_BASES: dict = {}


def _truth_held_out(world: World) -> float:
    """The median error on held-out windows of the very model that made them, on the user's mesh and at their step [mm]:
    what no diagnosis can go below."""
    from caphy.measure.scene import Scene
    from caphy.measure.track import registered
    from caphy.refit.study import Study

    model = world.model
    for name, values in world.answer["effects"].items():
        model = model.with_effect(name, **{**model.effects.get(name, {}), **values})
    responses = Study([registered(Scene.of(m), model) for m in world.held_out]).respond(model, ())
    return 1e3 * float(np.nanmedian(np.concatenate([response.error.ravel() for response in responses])))


def main() -> None:
    """Run what is missing, then print the table."""
    options = tyro.cli(Options)
    known = rows(options.results)
    like = [row for row in known if _kind(row)[1:] == (options.noise_mm, options.points or 0, options.wrong)]
    done = {(r["kind"], r["scene"], r["hidden"], r["seed"]) for r in like}
    left = [case for case in cases(options) if case not in done]
    began = time.time()
    context = multiprocessing.get_context("spawn")
    queue, answers = context.Queue(), context.Queue()
    for case in left:
        queue.put(case)
    for _ in range(options.workers):
        queue.put(None)
    workers = [context.Process(target=_work, args=(queue, answers, options, began)) for _ in range(options.workers)]
    raise SystemExit(_collected(options, left, workers, answers))


def _collected(options: Options, left: Sequence[Case], workers: list, answers) -> int:
    for worker in workers:
        worker.start()
    finished = 0
    while finished < len(workers):
        row = answers.get()
        if row is None:
            finished += 1
            continue
        with options.results.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        print(line(row), flush=True)
    found = rows(options.results)
    print(table(found))
    write_text(options.results.with_suffix(".md"), page(found))
    return 0


def _work(queue, answers, options: Options, began: float) -> None:
    end_at_ctrl_c()
    while (case := queue.get()) is not None and time.time() - began < 60 * options.minutes:
        try:
            answers.put(run(case, options))
        except Exception as error:
            kind, scene, name, seed = case
            row = {"kind": kind, "scene": scene, "hidden": name, "seed": seed, "noise_mm": options.noise_mm,
                   "points": options.points, "wrong": options.wrong}  # fmt: skip
            answers.put({**row, "error": f"{type(error).__name__}: {error}"})
    answers.put(None)


def rows(path: Path) -> list[dict]:
    """What a results file holds."""
    if not path.exists():
        return []
    return [json.loads(text) for text in path.read_text(encoding="utf-8").splitlines() if text.strip()]


def line(row: dict) -> str:
    """One case in a line."""
    if "error" in row:
        return f"{row['scene']:8s} {row['hidden']:32s} failed: {row['error']}"
    d = row["diagnosis"]
    best = d["ranking"][0]
    held = "" if d["held_out"] is None else f"{d['held_out']['before_mm']:.2f} -> {d['held_out']['after_mm']:.2f} mm"
    mark = "ok" if right(row) else "near" if near(row) else "WRONG"
    return (
        f"{row['scene']:8s} {row['hidden']:32s} {mark:5s} {d['verdict']:14s} {','.join(d['found']) or '-':30s} "
        f"best {best['explanation']} {100 * best['gain']:.1f} % of {100 * d['gain_needed']:.1f} {held} "
        f"{row['cpu_seconds']['diagnosis']:.0f} s"
    )


def right(row: dict) -> bool:
    """The very answer: the effects hidden, or the verdict where there are none."""
    d, truth = row["diagnosis"], row["answer"]
    if row["kind"] in ("one", "pair"):
        return set(d["found"]) == set(truth["effects"])
    return d["verdict"] == truth["verdict"]


def near(row: dict) -> bool:
    """Right but for effects that move the cloth alike, by the challenge's list or the diagnosis' own group."""
    d, truth = row["diagnosis"], row["answer"]
    if row["kind"] not in ("one", "pair"):
        return right(row)
    return all(
        any(name == f or f in truth["alike"].get(name, ()) or name in d["groups"].get(f, ()) for f in d["found"])
        for name in truth["effects"]
    )


def first(row: dict) -> bool:
    """Whether the screen put (one of) the hidden effects first."""
    return row["diagnosis"]["ranking"][0]["effect"] in row["answer"]["effects"]


def table(found: Sequence[dict]) -> str:
    """The numbers, and every failure."""
    good = [row for row in found if "error" not in row]
    lines = [""]
    for scene, noise, points, wrong in sorted({_kind(row) for row in good}):
        part = [row for row in good if _kind(row) == (scene, noise, points, wrong)]
        what = f", clouds of {points} points" if points else ""
        what += f", stiffnesses wrong by {100 * wrong:g} %" if wrong else ""
        lines += [f"{scene}, {noise:g} mm noise{what}", *_part(part)]
    lines += ["", "failures"]
    lines += [f"  {line(row)}" for row in found if "error" in row or not near(row)]
    return "\n".join(lines)


def page(found: Sequence[dict]) -> str:
    """The numbers, and every case with what was hidden and what was told, as Markdown."""
    lines = ["# Diagnoses of hidden effects", "", "```", table(found).strip(), "```", ""]
    titles = "scene", "hidden", "said", "hidden number: told (95 % interval)", "held out [mm]: before, after, the truth"
    lines += [f"| {' | '.join(titles)} |", "|---|---|---|---|---|"]
    kinds = ("one", "pair", "outside", "none")
    good = (row for row in found if "error" not in row)
    for row in sorted(good, key=lambda row: (_kind(row), row["seed"], kinds.index(row["kind"]), row["hidden"])):
        d = row["diagnosis"]
        held = d["held_out"]
        medians = [held["before_mm"], held["after_mm"]] if held else []
        medians += [d["truth_held_out_mm"]] if held and d.get("truth_held_out_mm") else []
        said = " + ".join(" or ".join(d["groups"][name]) for name in d["found"]) or d["verdict"]
        mark = "" if right(row) else "(near) " if near(row) else "**wrong** "
        numbers, shown = "; ".join(told_numbers(row)), ", ".join(f"{median:.2f}" for median in medians)
        lines += [f"| {row['scene']} {row['seed']} | {row['hidden']} | {mark}{said} | {numbers} | {shown} |"]
    return "\n".join(lines) + "\n"


def told_numbers(row: dict) -> Iterator[str]:
    """Each hidden number that the diagnosis told: the truth, what was told, and its interval."""
    for effect, values in row["answer"]["effects"].items():
        for name, value in values.items():
            for place, one in np.ndenumerate(np.asarray(value, dtype=float)):
                told = row["diagnosis"]["coefficients"].get(key(effect, name, place))
                if told is not None and (one or told["value"]):
                    missed = "" if told["low"] <= one <= told["high"] else ", missed"
                    span = f"{told['low']:.3g} to {told['high']:.3g}{missed}"
                    yield f"{name}{list(place) or ''} {one:.3g}: {told['value']:.3g} ({span})"


def key(effect: str, name: str, place: Sequence[int]) -> str:
    """What a diagnosis calls a number: an entry of a parameter, or all of it where that is a scalar."""
    return f"{effect}.{name}" + (f"[{','.join(map(str, place))}]" if place else "")


def _kind(row: dict) -> tuple[str, float, int, float]:
    return row["scene"], row["noise_mm"], row.get("points") or 0, row.get("wrong", 0.0)


def _part(part: Sequence[dict]) -> Iterator[str]:
    def of(kind: str) -> list[dict]:
        return [row for row in part if row["kind"] == kind]

    one, none, outside, pair = of("one"), of("none"), of("outside"), of("pair")
    yield _share("one effect: ranked first by the screen", one, first)
    yield _share("one effect: named, nothing else named", one, right)
    yield _share("one effect: named, or one that moves the cloth alike", one, near)
    yield _share("nothing hidden: an effect named", none, lambda row: bool(row["diagnosis"]["found"]))
    yield _share("two effects: both found", pair, near)
    yield _share("two effects: no third", pair, lambda row: len(row["diagnosis"]["found"]) <= 2)
    yield _share("outside the library: flagged", outside, right)
    yield _share(
        "inside the library: flagged as outside", one, lambda row: row["diagnosis"]["verdict"] == "none of these"
    )
    errors, covered = coefficients([row for row in one if right(row)])
    if errors:
        close = _of([error < 0.25 for error in errors])
        yield f"  coefficient: median error {100 * np.median(errors):.0f} %, within 25 %: {close}"
        yield f"  95 % interval covers: {_of(covered)}"
    held = [row["diagnosis"]["held_out"] for row in one if row["diagnosis"]["held_out"]]
    floors = [row["diagnosis"]["base"]["median_mm"] for row in one if row["diagnosis"]["held_out"]]
    if held:
        shares = [
            (h["before_mm"] - h["after_mm"]) / max(h["before_mm"] - f, 1e-9) for h, f in zip(held, floors, strict=True)
        ]
        yield f"  held-out median error: {100 * np.median(shares):.0f} % of the excess over the base's is gone (median)"
    shares = list(_gone_of_what_can_go(one))
    if shares:
        yield f"  ... of the excess over the true model's, same mesh and step: {100 * np.median(shares):.0f} % (median)"
    if part:
        cpu = [row["cpu_seconds"]["diagnosis"] for row in part]
        yield f"  processor time of a diagnosis: median {np.median(cpu):.0f} s"


def _gone_of_what_can_go(one: Sequence[dict]) -> Iterator[float]:
    """Shares of the held-out excess over that of the true model, where there is an excess of half a noise."""
    for row in one:
        held, floor = row["diagnosis"]["held_out"], row["diagnosis"].get("truth_held_out_mm")
        if held and floor is not None and held["before_mm"] - floor > 0.5 * row["noise_mm"]:
            yield (held["before_mm"] - held["after_mm"]) / (held["before_mm"] - floor)


def coefficients(found: Sequence[dict]) -> tuple[list[float], list[bool]]:
    """Relative errors of scalar coefficients, and whether the interval covers the truth."""
    errors, covered = [], []
    for row in found:
        for effect, values in row["answer"]["effects"].items():
            for name, value in values.items():
                told = row["diagnosis"]["coefficients"].get(f"{effect}.{name}")
                if told is not None and np.ndim(value) == 0 and value:
                    errors.append(abs(told["value"] / value - 1))
                    covered.append(told["low"] <= value <= told["high"])
    return errors, covered


def _share(what: str, part: Sequence[dict], good: Callable[[dict], bool]) -> str:
    return f"  {what}: {_of([good(row) for row in part])}"


def _of(flags) -> str:
    flags = list(flags)
    return f"{sum(map(bool, flags))} of {len(flags)}" + (f" ({100 * np.mean(flags):.0f} %)" if flags else "")


if __name__ == "__main__":
    main()
