"""``caphy fit`` with little to do: few rounds, one family of coarse garments. Run as a script it can be killed."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import torch

OPTIONS = ("--steps", "6", "--fabric-rounds", "1", "--collision-epochs", "1", "--seed", "3")


def softer(arguments: list[str]) -> int:
    """In place of ``caphy fabric``: writes the start with half its bending stiffness where that command does."""
    from caphy.effects.presets import fabric_model

    run, name = Path(arguments[0]), arguments[arguments.index("--fabric") + 1]
    start = fabric_model(name)
    model = start.with_effect("bending_measured", bending=0.5 * start.effects["bending_measured"]["bending"])
    found = {}
    for kind in ("upper", "lower"):
        (run / f"fabric_{kind}.json").write_text(model.to_json())
        stiffness = {"bending_measured": {"over_the_start": 0.5, "interval": [0.4, 0.6]}}
        found[kind] = {"stiffness": stiffness, "model_file": f"fabric_{kind}.json"}
    (run / "fabric.json").write_text(json.dumps({"garments": found}))
    return 0


def hurry(put=setattr) -> None:
    """Have the registration look at less; ``put`` as setattr."""
    from caphy.commands import fabric
    from caphy.garment.families import make_nearest
    from caphy.register import fit, hanging, template
    from caphy.training import collide

    torch.set_num_threads(1)
    put(fit, "ROUNDS", 4)
    put(template, "KINDS", {"upper": ("tshirt",), "lower": ("shorts",)})
    put(template, "EASES", {"tshirt": ({},), "shorts": ({},)})
    put(template, "STYLES", 12)
    put(template, "refined", lambda style, judge, _: (style, judge))
    put(
        template,
        "made",
        lambda style, figure: make_nearest(replace(style, edge_length=0.036), template.dressed_body(figure)),
    )
    put(hanging, "ROUNDS", 1)
    put(hanging, "EDGE_LENGTH", 0.05)
    put(hanging, "ITERATIONS", 5)
    put(collide, "LEAST_STEPS", 2)
    put(fabric, "main", softer)


if __name__ == "__main__":
    from caphy.cli import main

    hurry()
    raise SystemExit(main(["fit", *sys.argv[1:], *OPTIONS]))
