"""A page that shows a model before and after a change, side by side on the same measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from caphy.commands.compare import Progress, predicted

if TYPE_CHECKING:
    from caphy.body.model import BodyModel
    from caphy.effects.model import Model
    from caphy.garment.template import Garment
    from caphy.io.measurements import Measurement
    from caphy.refit.crew import Crew


def before_and_after(
    name: str,
    before: Model,
    after: Model,
    measured: Sequence[Measurement],
    crew: Crew,
    garment: Garment | None = None,
    body: BodyModel | None = None,
    notes: Sequence[str] = (),
) -> str:
    """The heat maps of measurements before and after, as one self-contained HTML page.

    Args:
        name: the model's.
        crew: rolls out the windows.
        notes: what is to be said of the change, at the foot.
    """
    from caphy import __version__
    from caphy.measure.comparison import compare
    from caphy.measure.pictures import section
    from caphy.measure.scene import Scene
    from caphy.report.page.compose import comparison_page

    sections = []
    for when, model in (("before", before), ("after", after)):
        for measurement in measured:
            scene = Scene.of(replace(measurement, name=f"{measurement.name}, {when}"), garment, body)
            with Progress(f"page, {when}") as progress:
                prediction = predicted(scene, model, progress, crew)
            sections.append(section(compare(prediction, scene.measurement, scene.regions)))
    facts = {"model": name, "written by": f"caphy {__version__}"}
    if notes:
        facts["note"] = "; ".join(notes)
    added = ", ".join(effect for effect in after.effects if effect not in before.effects) or "parameters"
    return comparison_page(f"{name}: before and after {added}", sections, facts)
