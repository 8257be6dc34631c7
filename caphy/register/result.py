"""A finished body fit on disk: ``body.npz`` for programs, ``body.json`` for people."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_COUNT
from caphy.errors import CaphyError
from caphy.garment.template import read_npz, write_npz
from caphy.io.places import write_text
from caphy.register.articulation import Figure, Placement
from caphy.register.fit import BodyFit, ScanFigures

FORMAT = "caphy-body-fit-1"
SAME = 1e-4
"""How far the person of a fit may lie from where it was fitted, on the body it is read with [m]."""


def write_fit(fit: BodyFit, folder: Path, body: str) -> None:
    """Write a fit made with the body file or name ``body``, each file whole or not at all."""
    rest, joints = fit.figure.rest
    arrays = {
        "format": np.array(FORMAT),
        "body": np.array(body),
        "betas": fit.figure.betas,
        "displacement": fit.figure.displacement,
        "rest_vertices": rest,
        "rest_joints": joints,
        "faces": fit.figure.body.faces,
        "names": np.array(fit.names),
        "poses": np.stack([placement.pose for placement in fit.placements]),
        "transl": np.stack([placement.transl for placement in fit.placements]),
        "figures": np.array([list(asdict(figures).values()) for figures in fit.figures]),
    }
    write_npz(folder / "body.npz", arrays)
    scans = {name: asdict(figures) for name, figures in zip(fit.names, fit.figures, strict=True)}
    document = {
        "format": FORMAT,
        "units": "metres; outside is a share of the cloth points",
        "body": body,
        "betas": fit.figure.betas.tolist(),
        "displacement_mean": float(np.linalg.norm(fit.figure.displacement, axis=1).mean()),
        "scans": scans,
        "left_out": fit.failures,
    }
    write_text(folder / "body.json", json.dumps(document, indent=1, allow_nan=False))


def read_fit(path: Path, body: BodyModel) -> BodyFit:
    """What :func:`write_fit` wrote, on the same body.

    Raises:
        CaphyError: the file is missing, is no body fit, or belongs to another body.
    """
    arrays = read_npz(path)
    if str(arrays.get("format")) != FORMAT:
        raise CaphyError(f"{path}: must be a body fit of format {FORMAT!r}; make one with 'caphy register body'")
    shapes = {"displacement": body.v_template.shape, "poses": (len(arrays["names"]), JOINT_COUNT, 3)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise CaphyError(
                f"{path}: {name} must have shape {shape} on this body, got {arrays[name].shape}; the fit was made with "
                f"the body {str(arrays['body'])!r}: give the same with --body"
            )
    figure = Figure(body, arrays["betas"], arrays["displacement"])
    for rest, name in zip(figure.rest, ("rest_vertices", "rest_joints"), strict=True):
        apart = np.abs(rest - arrays[name]).max()
        if apart > SAME:  # of another sex: meshes have as many vertices
            raise CaphyError(
                f"{path}: on this body its person lies up to {1000 * apart:.0f} mm from where it was fitted; the fit "
                f"was made with the body {str(arrays['body'])!r}: give the same with --body"
            )
    return BodyFit(
        figure=figure,
        names=tuple(str(name) for name in arrays["names"]),
        placements=tuple(Placement.of(p, t) for p, t in zip(arrays["poses"], arrays["transl"], strict=True)),
        figures=tuple(ScanFigures(*row) for row in arrays["figures"].tolist()),
        failures={},
    )
