"""A fitted fabric as JSON: the model, how it came about, and how sure each number is."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from caphy.effects.model import Model
from caphy.fabric.certainty import LEVEL, Certainty
from caphy.fabric.rounds import Fitted, Objective

NOT_DETERMINED = "not determined"


def settled_model(fitted: Fitted, sure: Certainty, data: tuple[str, ...] = ()) -> Model:
    """The model found, with the start's table where the scans determine none, and the change in its history."""
    determined = [name for name in fitted.numbers.names if sure.determined[name]]
    note = f"{' and '.join(determined)} fitted to scans at rest" if determined else "scans at rest determined nothing"
    known = np.array([sure.determined[fitted.numbers.names[group]] for group in fitted.numbers.group])
    start = fitted.numbers.start
    kept = np.array([column.value(start) for column in fitted.numbers.columns])
    model = fitted.numbers.model(np.where(known, fitted.values, kept))
    return model.revised(start, note, data=data)


def record(fitted: Fitted, sure: Certainty, model: Model, objective: Objective) -> dict[str, Any]:
    """Everything worth keeping of a fit, ready for JSON; numbers that scans leave open say so instead of a figure."""
    numbers = fitted.numbers
    stiffness = {
        name: {
            "over_the_start": round(fitted.stiffness[name], 4) if sure.determined[name] else NOT_DETERMINED,
            "interval": [round(sure.low[name], 4), round(sure.high[name], 4)] if sure.determined[name] else None,
            "over_density_si": None,
        }
        for name in numbers.names
    }
    for name in numbers.names:
        if sure.determined[name]:
            mine = numbers.group == numbers.names.index(name)
            mean = float(fitted.energy[mine] @ fitted.values[mine] / max(fitted.energy[mine].sum(), 1e-300))
            stiffness[name]["over_density_si"] = mean / numbers.start.density
    entries = [
        {
            "name": column.name,
            "unit": column.unit,
            "start": column.value(numbers.start),
            "found": float(found) if sure.determined[numbers.names[group]] else NOT_DETERMINED,
        }
        for column, found, group in zip(numbers.columns, fitted.values, numbers.group, strict=True)
    ]
    return {
        "objective": objective,
        "scans": len(fitted.rounds[-1].said),
        "left_out": fitted.left_out,
        "settled": fitted.settled,
        "level": LEVEL,
        "stiffness": stiffness,
        "numbers": entries,
        "rounds": [
            {
                "stiffness_over_the_start": one.stiffness,
                "scans": len(one.said),
                "median_distance_m": one.median,
                "mesh_corrected": one.corrected,
            }
            for one in fitted.rounds
        ],
        "note": (
            "Scans of cloth at rest tell stiffness over density only; the density was given. Where it should be "
            "another, all stiffnesses change in proportion. A table counts as a whole: its entries make up for one "
            "another, and single ones are not to be trusted."
        ),
        "model": json.loads(model.to_json()),
    }
