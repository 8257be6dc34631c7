"""A diagnosis of tensile tests as files: all figures as JSON, a page to look at, models to go on with."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from caphy.effects.model import Model
from caphy.io.places import write_text
from caphy.tensile.diagnosis import CurveDiagnosis
from caphy.tensile.errors import STAGES
from caphy.tensile.fit import Fit, remembering
from caphy.tensile.loadings import Loading, Tests
from caphy.tensile.refit import CurveRefit


def figures(diagnosis: CurveDiagnosis) -> dict:
    """Everything of a diagnosis, ready for JSON."""
    return {
        "schema": "caphy-tensile-1",
        "verdict": diagnosis.verdict,
        "found": [{"effect": name, "from_loading": 1} for name in diagnosis.found]
        + [{"effect": name, "from_loading": 2} for name in diagnosis.found_used],
        "doubtful": list(diagnosis.doubtful),
        "complete": diagnosis.complete,
        "left": diagnosis.left,
        "sentences": diagnosis.sentences,
        "rivals": list(diagnosis.rivals),
        "ambiguity": list(diagnosis.ambiguity),
        "cautions": list(diagnosis.cautions),
        "ranking": [_finite(asdict(row)) | {"accepted": row.accepted} for row in diagnosis.ranking],
        "coefficients": [asdict(row) for row in diagnosis.coefficients],
        "summary": diagnosis.summary,
        "loadings": [asdict(row) for row in diagnosis.loadings],
        "fabrics": dict(diagnosis.fabrics),
        "depends_on": dict(diagnosis.dependence.shares),
        "not_shown_by_these_tests": dict(diagnosis.unseen),
        "curves": [row for fabric in diagnosis.models for row in _curves(diagnosis, fabric)],
    }


def _finite(row: dict) -> dict:
    return {key: None if isinstance(v, float) and not np.isfinite(v) else v for key, v in row.items()}


def _curves(diagnosis: CurveDiagnosis, fabric: str) -> list[dict]:
    """One row per direction: what was measured and what each stage says, first loading and used cloth."""
    fits: dict[str, Fit] = {stage: diagnosis.fits[stage][fabric] for stage in STAGES}
    said = {stage: fit.bench.curves(fit.numbers, fit.values) for stage, fit in fits.items()}
    return [_curve_row(test, said) for test in fits["as given"].bench.tests]


def _curve_row(test: Tests, said: dict) -> dict:
    models = {
        stage: {
            "used" if used else "first": {"force": curve[0].tolist(), "transverse": curve[1].tolist()}
            for (direction, used), curve in curves.items()
            if direction == test.direction
        }
        for stage, curves in said.items()
    }
    return {
        "fabric": test.fabric,
        "direction": test.direction,
        "axial": test.axial.tolist(),
        "models": models,
        "measured": [_measured(loading) for loading in test.loadings],
    }


def _measured(loading: Loading) -> dict:
    seen = np.isfinite(loading.force)
    across = [float(t) if np.isfinite(t) else None for t in loading.transverse[seen]]
    return {
        "loading": loading.curve.loading,
        "axial": loading.strain[seen].tolist(),
        "force": loading.force[seen].tolist(),
        "transverse": across,
    }


def write(
    result: CurveDiagnosis | CurveRefit,
    folder: str | Path,
    title: str = "Tensile tests",
    since: Model | None = None,
    data: Sequence[str] = (),
    read: Sequence[Path] = (),
) -> list[Path]:
    """Write diagnosis.json (refit.json), its page, and the model of each fabric; returns the paths.

    The models are of used cloth, which remembers the largest energy of either direction; where the first loading
    differs, ``FABRIC_first.json`` is of that. With ``since``, the model that was fitted, to tables called ``data``,
    their history says so. Models have no name of a file that was ``read`` from the same folder.
    """
    from caphy import __version__
    from caphy.report.page.compose import tensile_page

    refit = isinstance(result, CurveRefit)
    diagnosis = result.outcome if isinstance(result, CurveRefit) else result
    document = figures(diagnosis)
    if isinstance(result, CurveRefit):
        document |= {"kept": list(result.kept), "refused": dict(result.refused), "sentences": result.sentences}
    name, folder = "refit" if refit else "diagnosis", Path(folder)
    texts = {
        f"{name}.json": json.dumps(document, indent=1, allow_nan=False),
        f"{name}.html": tensile_page(title, document, {"written by": f"caphy {__version__}"}),
    }
    mine = folder.resolve()
    slugs = _slugs(diagnosis.models, [path.stem for path in read if path.resolve().parent == mine])
    for fabric, (first, used) in diagnosis.models.items():
        reached = max(test.reached for test in diagnosis.fits["as given"][fabric].bench.tests)
        texts[f"{slugs[fabric]}.json"] = _revised(
            remembering(used, reached), since, f"fitted to tensile tests of {fabric}", data
        )
        if diagnosis.found_used:
            note = f"fitted to first loadings in tensile tests of {fabric}"
            texts[f"{slugs[fabric]}_first.json"] = _revised(remembering(first, reached), since, note, data)
        else:  # of another answer
            (folder / f"{slugs[fabric]}_first.json").unlink(missing_ok=True)
    for file, text in texts.items():
        write_text(folder / file, text)
    return [folder / file for file in texts]


def _revised(model: Model, since: Model | None, note: str, data: Sequence[str]) -> str:
    if since is None:
        return model.to_json()
    return (since if model == since else model.revised(since, note, data=data)).to_json()


def _slugs(names: Iterable[str], others: Sequence[str] = ()) -> dict[str, str]:
    """File names of fabrics, each its own, and none that of the answer, of another's first loading or of ``others``."""
    found: dict[str, str] = {}
    for name in names:
        plain = "".join(c if c.isalnum() else "_" for c in name).strip("_").lower() or "cloth"
        taken = {"diagnosis", "refit", *others, *found.values(), *(f"{slug}_first" for slug in found.values())}
        slug, number = plain, 2
        while slug in taken or f"{slug}_first" in taken:
            slug, number = f"{plain}_{number}", number + 1
        found[name] = slug
    return found
