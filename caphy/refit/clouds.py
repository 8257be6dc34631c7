"""Clouds of several measurements become vertices, side by side where processes share the work."""

from __future__ import annotations

from collections.abc import Sequence

from caphy.effects.model import Model
from caphy.measure.scene import Scene
from caphy.measure.track import Progress, registered
from caphy.refit.crew import Crew


def all_registered(
    scenes: Sequence[Scene], model: Model, progress: Progress | None = None, crew: Crew | None = None
) -> list[Scene]:
    """Scenes as :func:`~caphy.measure.track.registered`, with a model's help; those without clouds stay as they are.

    ``crew`` shares the work, this process does it unless given.

    Raises:
        CaphyError: what registering raised.
    """
    found = list(scenes)
    clouds = [place for place, scene in enumerate(found) if scene.measurement.vertices is None]
    if crew is None:
        for place in clouds:
            found[place] = registered(found[place], model, progress)
        return found
    for done, (number, scene) in enumerate(crew.register([found[place] for place in clouds], model), 1):
        found[clouds[number]] = scene
        if progress is not None:
            progress("registering", done, len(clouds))
    return found
