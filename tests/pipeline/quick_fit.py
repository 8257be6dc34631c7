"""``caphy fit`` with little to do: few rounds, one family of coarse garments. Run as a script it can be killed."""

from __future__ import annotations

import sys
from dataclasses import replace

import torch

OPTIONS = ("--steps", "6", "--collision-epochs", "1", "--seed", "3")


def hurry(put=setattr) -> None:
    """Have the registration look at less; ``put`` as setattr."""
    from caphy.garment.families import make
    from caphy.register import fit, template
    from caphy.training import collide

    torch.set_num_threads(1)
    put(fit, "ROUNDS", 4)
    put(template, "KINDS", {"upper": ("tshirt",), "lower": ("shorts",)})
    put(template, "EASES", {"tshirt": ({},), "shorts": ({},)})
    put(template, "STYLES", 12)
    put(template, "refined", lambda style, judge, targets, marks: (judge(style), style))
    put(
        template,
        "made",
        lambda choice, figure: make(replace(choice.style, edge_length=0.048), template.dressed_body(figure)),
    )
    put(collide, "LEAST_STEPS", 2)


if __name__ == "__main__":
    from caphy.cli import main

    hurry()
    raise SystemExit(main(["fit", *sys.argv[1:], *OPTIONS]))
