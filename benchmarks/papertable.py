"""The table of CaPhy's section 4 for a run of ``caphy fit``: trains what each row needs, with several seeds.

``python -m benchmarks.papertable RUN --poses MOCAP --minutes 20 --seeds 3``. All rows of a garment get the same
minutes, templates, body and split. Goes on where it was stopped; ``caphy evaluate`` prints the table at the end.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from caphy.evaluate.rows import fabrics_found, worn


@dataclass(frozen=True)
class Recipe:
    """How one row is trained."""

    folder: str
    """Under RUN/rows; caphy.evaluate.rows names the row."""
    scans: bool
    """Whether scans supervise it."""
    physics: str
    """none, snug (constant StVK), fabric (the measured one the run started from) or optimised."""


RECIPES = (
    Recipe("data_only", True, "none"),
    Recipe("snug", False, "snug"),
    Recipe("no_data", False, "fabric"),
    Recipe("default_physics", True, "fabric"),
    Recipe("ours", True, "optimised"),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a finished 'caphy fit'")
    parser.add_argument("--poses", type=Path, nargs="*", default=[], help="motions for the physics")
    parser.add_argument("--minutes", type=float, default=20.0, help="of training for each garment of each row and seed")
    parser.add_argument("--steps", type=int, help="steps instead of minutes")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--fabric", default="gray-interlock", help="the measured fabric the run started from")
    parser.add_argument("--rows", nargs="*", choices=[recipe.folder for recipe in RECIPES], help="only these")
    given = parser.parse_args()
    recipes = [recipe for recipe in RECIPES if not given.rows or recipe.folder in given.rows]
    jobs = [
        (recipe, seed, kind) for seed in range(1, given.seeds + 1) for recipe in recipes for kind in worn(given.run)
    ]
    failed, started = [], monotonic()
    for number, (recipe, seed, kind) in enumerate(jobs):
        left = (monotonic() - started) / max(number, 1) * (len(jobs) - number) / 60
        print(f"[{number + 1} of {len(jobs)}] {recipe.folder}, seed {seed}, {kind}; {left:.0f} min left", flush=True)
        if not _trained(given, recipe, seed, kind):
            failed.append(f"{recipe.folder}, seed {seed}, {kind}")
    if failed:
        print("not trained: " + "; ".join(failed), file=sys.stderr)
    return _caphy("evaluate", given.run / "scans", "-o", given.run, "--labels", given.run / "labels")


def _trained(given: argparse.Namespace, recipe: Recipe, seed: int, kind: str) -> bool:
    """Train one network, or what is missing of it."""
    run, folder = given.run, given.run / "rows" / recipe.folder / f"seed_{seed}" / kind
    budget = ["--steps", given.steps] if given.steps else ["--minutes", given.minutes]
    words = [
        run / f"{kind}.npz",
        *given.poses,
        "-o",
        folder,
        *budget,
        "--seed",
        seed,
        "--body",
        run / "subject_body.npz",
    ]
    words += ["--scans", run] if recipe.scans else []
    # As in 'caphy fit'; what the default avatar knows is physics.
    words += ["--no-physics"] if recipe.physics == "none" else ["--transfer", "default"]
    if recipe.physics == "fabric":
        words += ["--fabric", given.fabric]
    elif recipe.physics == "optimised":
        unknown = [one for one in worn(run) if one not in fabrics_found(run)]
        if unknown:  # an earlier fit may have left the models of garments of which this one found nothing
            told = f"{run / 'fabric.json'}: tells no fabric of the {' and '.join(unknown)} garment"
            print(f"{told}, so this row cannot be trained; fit it with 'caphy fabric {run}'", file=sys.stderr)
            return False
        words += ["--model", run / f"fabric_{kind}.json"]
    if (folder / "checkpoint.safetensors").is_file():
        words += ["--resume"]
    return _caphy("train", *words) == 0


def _caphy(*words: object) -> int:
    command = [sys.executable, "-m", "caphy.cli", *map(str, words)]
    return subprocess.run(command, check=False).returncode


if __name__ == "__main__":
    raise SystemExit(main())
