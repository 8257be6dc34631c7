"""The beginning of a user's own effect: a file that passes the battery as it stands."""

from __future__ import annotations

import keyword
import os
import tempfile
from pathlib import Path

from caphy.effects.registry import registered_effects
from caphy.errors import CaphyError

TEMPLATE = '''"""{title}: say in one line what it is."""

from caphy.effects.base import Effect, Parameter
from caphy.effects.vectors import dot


class {class_name}(Effect):
    """Say what pushes the cloth and when, with the formula of the energy: E = dt c a / 2 |v|^2 [J] per vertex.

    As it stands this is a drag in all directions. What you can read in energy(): e.x, positions (k, 3, ..., n) of the
    element's k vertices [m]; e.velocity [m/s], e.lagged (positions of the step before) and e.dt [s] in motion; e.body
    with point, normal, velocity and anchor (3, ..., n) if needs_body; e.rest, what rest() gives. The component axis
    comes before the frames and the elements: use dot, cross and norm of caphy.effects.vectors. A force that you know
    instead of an energy is the potential -force . x, its force evaluated at e.lagged and e.lagged_velocity.
    """

    name = "{name}"
    element = "vertex"  # or "edge", "face", "hinge" (an edge with its two triangles)
    group = "other"  # the family it belongs to: drag, wind, damping, stiffness, rest shape, mass, contact, external
    parameters = {{
        # default, unit, lower and upper bound, with 0 among them: no effect; linear=False where the energy is not
        # linear in it, which may be held away from 0: it is held at its default then, unless
        # further = {{"its name": (values at which to look for it, ...)}}  says to fit it too
        "coefficient": Parameter(0.5, "N s/m^3", 0.0, 100.0, doc="say what it measures"),
    }}
    reference = "say where the effect or its formula comes from"
    needs_step = True  # it acts only in motion (it reads velocity or history)

    def rest(self, cloth):
        """What each element is at rest: arrays whose last axis runs over the elements.

        cloth has vertices (V, 3), vertex_area, mass [kg] (V,), edges (E, 2), faces, material and face_area of faces,
        hinges (H, 4), density [kg/m^2], attached (V,) and more: see caphy/effects/cloth.py.
        """
        return {{"area": cloth.vertex_area}}

    def energy(self, e, p):
        """Energy of each element [J]; forces and stiffness follow by automatic differentiation."""
        (velocity,) = e.velocity
        return 0.5 * e.dt * p["coefficient"] * e.rest["area"] * dot(velocity, velocity)
'''


def write_scaffold(name: str, path: Path) -> None:
    """Write the beginning of an effect to a file that must not exist yet.

    Raises:
        CaphyError: the name is no lower-case Python name or taken, or the file exists or cannot be written.
    """
    if not (name.isidentifier() and name == name.lower()) or keyword.iskeyword(name):
        raise CaphyError(
            f"the name of an effect must be like my_effect (lower case, no spaces, no word of Python's), got {name!r}"
        )
    if name in registered_effects():
        raise CaphyError(f"there already is an effect {name!r}; give yours another name")
    words = name.strip("_").split("_")
    class_name = "".join(map(str.title, words))
    if not class_name.isidentifier() or keyword.iskeyword(class_name):
        raise CaphyError(f"the name of an effect must be like my_effect, and no word of Python's, got {name!r}")
    if path.suffix != ".py":
        raise CaphyError(f"{path}: an effect's file must be a .py file")
    text = TEMPLATE.format(name=name, title=" ".join(words).capitalize(), class_name=class_name)
    try:
        _write_new(path, text)
    except FileExistsError as error:
        raise CaphyError(f"{path}: exists already; choose another file with -o") from error
    except OSError as error:
        raise CaphyError(f"{path}: cannot be written: {error.strerror}") from error


def _write_new(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all, and never in place of another."""
    handle, partial = tempfile.mkstemp(dir=path.parent, prefix=path.name, suffix=".partial")
    try:
        with os.fdopen(handle, "w") as stream:
            stream.write(text)
        os.chmod(partial, 0o644)
        os.link(partial, path)
    finally:
        Path(partial).unlink(missing_ok=True)
