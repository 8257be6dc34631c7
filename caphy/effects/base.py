"""The contract of a physical effect: one small file, one incremental potential.

An effect says which elements it acts on (``element``), what its parameters are, and the energy of one element.
Everything else - gradient, Hessian, network loss, solver, refit, diagnosis, report, tests - follows from that:

    class Gravity(Effect):
        "Weight of the cloth."
        name = "gravity"
        element = "vertex"
        parameters = {"acceleration": Parameter((0.0, -9.81, 0.0), "m/s^2", doc="acceleration of free fall")}
        reference = "Newton 1687"

        def energy(self, e, p):
            (x,) = e.x
            return -e.rest["mass"] * dot(p["acceleration"], x)

Energies are written with the component axis first (see :mod:`caphy.effects.vectors`) and broadcast over any
number of frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from caphy.effects.cloth import Cloth
from caphy.errors import CaphyError

ElementKind = Literal["vertex", "edge", "face", "hinge"]

Group = Literal["stiffness", "rest shape", "damping", "drag", "wind", "mass", "contact", "external", "other"]
"""Families of effects; members of one family explain a measurement in similar ways."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect.

    Attributes:
        default: value, a float or nested tuples of floats (vectors, tables).
        unit: SI unit.
        lower, upper: bounds that every entry keeps.
        linear: the energy is linear in it, so that refits are (bounded) least squares.
        doc: one line for people.
    """

    default: float | tuple
    unit: str
    lower: float = -np.inf
    upper: float = np.inf
    linear: bool = True
    doc: str = ""


HISTORY = ("origin", "target", "lagged", "lagged_velocity")
"""What a step remembers."""


@dataclass(frozen=True)
class Step:
    """One incremental step of the dynamics, the same for every integrator.

    Implicit Euler has origin x(t-1), target 2 x(t-1) - x(t-2) and the frame's dt. A stage of a diagonally implicit
    Runge-Kutta method has its own origin, target and effective step, and the very same potential.

    Attributes:
        dt: effective step [s].
        origin: positions from which the velocity is measured, (..., V, 3) [m]: v = (x - origin) / dt.
        target: where the vertices would be without any force, (..., V, 3) [m].
        lagged: positions of the last converged state, (..., V, 3) [m]; lagged coefficients are evaluated there.
        lagged_velocity: velocities of the last converged state, (..., V, 3) [m/s].
        time: when the step ends [s], for what changes by the clock (gusts); (..., 1) where batched steps end apart.
        pressed: positions at which the body's push tells how much friction there is, (..., V, 3) [m]; where the last
            converged state is, carried along by the body, unless given.
        lead: by how much a stage's origin leads from the state that the whole step began with, through the last
            converged one and beyond: origin = (1 - lead) start + lead lagged; (..., 1) where batched steps differ.
    """

    dt: float
    origin: Tensor
    target: Tensor
    lagged: Tensor
    lagged_velocity: Tensor
    time: float | Tensor = 0.0
    pressed: Tensor | None = None
    lead: float | Tensor = 0.0

    @classmethod
    def implicit_euler(cls, dt: float, previous: Tensor, before: Tensor, time: float = 0.0) -> Step:
        """The step of implicit Euler after positions ``before`` = x(t-2) and ``previous`` = x(t-1), (..., V, 3)."""
        return cls(dt, previous, 2 * previous - before, previous, (previous - before) / dt, time)

    def map(self, function: Callable[[Tensor], Tensor]) -> Step:
        """This step with a function applied to each of its vertex fields."""
        pressed = None if self.pressed is None else function(self.pressed)
        fields = (function(getattr(self, field)) for field in HISTORY)
        return Step(self.dt, *fields, time=self.time, pressed=pressed, lead=self.lead)

    @property
    def start(self) -> Tensor:
        """Positions (..., V, 3) [m] that the whole step began with."""
        return began(self.origin, self.lagged, self.lead[..., None] if isinstance(self.lead, Tensor) else self.lead)


@dataclass(frozen=True)
class BodyState:
    """The body as the vertices of a garment see it in each frame.

    Attributes:
        point: nearest point of the body surface, (..., V, 3) [m].
        normal: gradient of the signed distance, (..., V, 3), unit length, outward.
        velocity: velocity of the body at that point, (..., V, 3) [m/s].
        anchor: where the skinned template has each vertex, (..., V, 3) [m]; what attached vertices are held to.
    """

    point: Tensor
    normal: Tensor
    velocity: Tensor
    anchor: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> BodyState:
        """This state with a function applied to each of its vertex fields."""
        return BodyState(*map(function, (self.point, self.normal, self.velocity, self.anchor)))


@dataclass(frozen=True)
class Elements:
    """All elements of one kind, in the layout energies are written in: component first, elements last.

    Attributes:
        x: positions of the k vertices of each element, (k, 3, ..., n) [m].
        rest: constants of each element, name -> (n,) or (..., n).
        dt: effective step [s]; None in statics.
        origin, target, lagged, lagged_velocity: as in :class:`Step`, each (k, 3, ..., n); None in statics.
        time: when the step ends [s]; None in statics.
        pressed: as in :class:`Step`, (k, 3, ..., n); only for effects that read the body, None where it is not given.
        lead: as in :class:`Step`.
        body: as in :class:`BodyState`, name -> (3, ..., n); only for effects that read the body.
        known: what was worked out of the history before, name -> what it was worked out of and the result.
    """

    x: Tensor
    rest: Mapping[str, Tensor]
    dt: float | None = None
    origin: Tensor | None = None
    target: Tensor | None = None
    lagged: Tensor | None = None
    lagged_velocity: Tensor | None = None
    time: float | Tensor | None = None
    pressed: Tensor | None = None
    lead: float | Tensor = 0.0
    body: Mapping[str, Tensor] | None = None
    known: dict[str, tuple[Tensor, Tensor]] | None = None

    def once(self, name: str, past: Tensor, work_out: Callable[[Tensor], Tensor]) -> Tensor:
        """What follows from a field of the history and constants alone; not worked out again while a step lasts."""
        kept = None if self.known is None else self.known.get(name)
        if kept is None or kept[0] is not past:
            kept = past, work_out(past)
            if self.known is not None:
                self.known[name] = kept
        return kept[1]

    def then(
        self, name: str, work_out: Callable[[Tensor], Tensor], apart: Callable[[Tensor, Tensor], Tensor] = torch.sub
    ) -> Tensor:
        """From which value of a strain or an angle its change over the step is counted: (now - then) / dt is its rate.

        A stage's origin leads beyond where the cloth ever was; of cloth that turns it is a stretched one, whose strain
        changes though nothing deforms. So the integrator's rule is applied to the strain itself.

        Args:
            name: of what is worked out.
            work_out: what no rigid motion changes, of positions (k, 3, ..., n) [m].
            apart: the difference of two such values.
        """
        origin, lead = self.origin, self.lead
        if origin is None:
            raise RuntimeError("statics has no rates; set needs_step on the effect")
        if not isinstance(lead, Tensor) and lead == 0:
            return self.once(name, origin, work_out)
        lagged = self.lagged
        assert lagged is not None
        first = self.once(f"{name} at the start", origin, lambda origin: work_out(began(origin, lagged, lead)))
        return first + lead * apart(self.once(f"{name} before", lagged, work_out), first)

    @property
    def velocity(self) -> Tensor:
        """Velocities (k, 3, ..., n) [m/s] of the step under way."""
        if self.origin is None or self.dt is None:
            raise RuntimeError("statics has no velocity; set needs_step on the effect")
        return (self.x - self.origin) / self.dt


def began(origin: Tensor, lagged: Tensor, lead: float | Tensor) -> Tensor:
    """Positions [m] that a step began with, of which a stage's origin is led away (:class:`Step`)."""
    return (origin - lead * lagged) / (1 - lead)


Values = Mapping[str, Tensor]
"""Parameter values of one effect, name -> tensor of the parameter's shape."""


class Effect:
    """Base of all effects. Subclasses live one per file in ``caphy/effects/``.

    Class attributes:
        name: the registered name, equal to the file's.
        element: what one element is.
        parameters: name -> :class:`Parameter`.
        reference: paper and equation.
        group: the family it belongs to.
        coefficients: the parameters that leave exactly nothing of the effect when all are zero, so that it can be
            tried as an addition to any model; unless said, those in which the energy is linear.
        internal: exerts no net force and no net torque.
        lacks: properties of the battery (names of :data:`caphy.effects.battery.CHECKS`) that it rightly lacks, and why.
        abrupt: the first bit of its coefficient does what more of it would, as dry friction, which stops what would
            slide: responses to it, where it is off, are told by a roll-out with the default instead of a tangent. Where
            a solver's steps go too far it mixes in :meth:`projected_hessian`.
        needs_step: acts only in motion (inertia, damping, friction); skipped in statics.
        reads_step: acts in statics too, but reads the step where there is one (mass: inertia and weight).
        needs_body: reads :class:`BodyState`; skipped where there is no body.
        refines: another effect of which this one is another law, where it is not linear in all that must be told of it
            and cannot be found from nothing: that one is found and fitted, and :meth:`start` goes on from there.
        further: parameters in which it is not linear and that are fitted too, once the effect is found, each with the
            values at which to look for it; with none it is looked for as by default.
        borrows: other effects whose parameters it reads too, as ``p["body_contact.stiffness"]``; the model must have
            them. Of a tuple of alternatives the model must have at least one, and those it has are lent.
        heeds: other effects whose parameters it reads where the model has them, and can do without.
        separate: parameters each entry of which acts in a place of its own, on one of the openings in their order, and
            explains by itself.
    """

    name: ClassVar[str]
    element: ClassVar[ElementKind]
    parameters: ClassVar[Mapping[str, Parameter]] = {}
    reference: ClassVar[str]
    group: ClassVar[Group] = "other"
    coefficients: ClassVar[tuple[str, ...]] = ()
    internal: ClassVar[bool] = False
    lacks: ClassVar[Mapping[str, str]] = {}
    abrupt: ClassVar[bool] = False
    needs_step: ClassVar[bool] = False
    reads_step: ClassVar[bool] = False
    needs_body: ClassVar[bool] = False
    refines: ClassVar[str | None] = None
    further: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    borrows: ClassVar[tuple[str | tuple[str, ...], ...]] = ()
    heeds: ClassVar[tuple[str, ...]] = ()
    separate: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        for key, declared in cls.parameters.items():
            if not isinstance(declared, Parameter):
                raise TypeError(
                    f"{cls.__name__}.parameters[{key!r}] must be Parameter(default, unit, lower, upper, doc=...), "
                    f"got {declared!r}"
                )
        if "parameters" in vars(cls) and "coefficients" not in vars(cls):
            cls.coefficients = tuple(key for key, parameter in cls.parameters.items() if parameter.linear)

    def start(self, found: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Own parameters that push the cloth about as those ``found`` of the effect that this one :attr:`refines`."""
        raise NotImplementedError(f"{type(self).__name__} must define start(found), since it refines {self.refines}")

    def lenders(self, present: Iterable[str]) -> tuple[str, ...] | None:
        """Those of ``present`` effects whose parameters this one reads; None if it lacks one that it needs."""
        names = set(present)
        found = [[other for other in _alternatives(entry) if other in names] for entry in self.borrows]
        found.append([other for other in self.heeds if other in names])
        return tuple(other for some in found for other in some) if all(found[:-1]) else None

    def index(self, cloth: Cloth) -> np.ndarray:
        """Vertex indices of each element, (n, k). Override to act on some elements only (a waistband, a hem)."""
        match self.element:
            case "vertex":
                return np.arange(len(cloth.vertices))[:, None]
            case "edge":
                return cloth.edges
            case "face":
                return cloth.faces
            case "hinge":
                return cloth.hinges

    def rest(self, cloth: Cloth) -> dict[str, np.ndarray]:
        """Constants of each element, name -> (n,) or (..., n), read back as ``e.rest[name]``."""
        return {}

    def energy(self, e: Elements, p: Values) -> Tensor:
        """Energy of each element [J], (..., n)."""
        raise NotImplementedError(f"{type(self).__name__} must define energy(e, p)")

    def gradient(self, e: Elements, p: Values) -> tuple[Tensor, Tensor]:
        """Energy (..., n) [J] and its gradient (k, 3, ..., n) [N] with the history held fixed.

        Automatic differentiation of :meth:`energy`; override with a closed form where speed pays.
        """
        x = e.x.detach().requires_grad_(True)
        with torch.enable_grad():
            energy = self._checked_energy(replace(e, x=x), p)
            (gradient,) = torch.autograd.grad(energy.sum(), x, allow_unused=True)
        return energy.detach(), torch.zeros_like(x) if gradient is None else gradient

    def _checked_energy(self, e: Elements, p: Values) -> Tensor:
        """:meth:`energy`; raises CaphyError where it gives something else than one number for each element."""
        energy, wanted = self.energy(e, p), tuple(e.x.shape[2:])
        if not isinstance(energy, Tensor) or tuple(energy.shape) != wanted:
            got = tuple(energy.shape) if isinstance(energy, Tensor) else type(energy).__name__
            raise CaphyError(f"{self.name}: energy(e, p) must return the energy of each element {wanted}, got {got}")
        if not energy.requires_grad:
            raise CaphyError(f"{self.name}: energy(e, p) must depend on e.x or e.velocity; it calls forth no force")
        return energy

    def hessian(self, e: Elements, p: Values) -> Tensor:
        """Second derivative of each element's energy [N/m], (k, 3, k, 3, ..., n).

        Automatic differentiation of :meth:`energy`; override with a closed form where speed pays.
        """
        x = e.x.detach().requires_grad_(True)
        with torch.enable_grad():
            energy = self.energy(replace(e, x=x), p)
            (gradient,) = torch.autograd.grad(energy.sum(), x, create_graph=True, allow_unused=True)
            rows = []
            for vertex in range(x.shape[0]):
                for axis in range(3):
                    row = None
                    if gradient is not None and gradient.requires_grad:
                        (row,) = torch.autograd.grad(
                            gradient[vertex, axis].sum(), x, retain_graph=True, allow_unused=True
                        )
                    rows.append(torch.zeros_like(x) if row is None else row)
        return torch.stack(rows).reshape(x.shape[:2] + x.shape).detach()

    def projected_hessian(self, e: Elements, p: Values) -> Tensor:
        """:meth:`hessian` with the negative eigenvalues of each element clamped to zero."""
        return clamp_eigenvalues(self.hessian(e, p))


def _alternatives(entry: str | tuple[str, ...]) -> tuple[str, ...]:
    return (entry,) if isinstance(entry, str) else entry


def companions(effect: Effect) -> tuple[str, ...]:
    """A choice of effects that a model must have beside this one: the first of each set of alternatives, and what those
    need themselves."""
    from caphy.effects.registry import find_effect

    found = dict.fromkeys(_alternatives(entry)[0] for entry in effect.borrows)
    left = list(found)
    while left:
        further = [_alternatives(entry)[0] for entry in find_effect(left.pop()).borrows]
        left += [name for name in further if name not in found]
        found |= dict.fromkeys(further)
    found.pop(effect.name, None)
    return tuple(found)


def lending(effect: Effect, present: Iterable[str]) -> tuple[str, ...]:
    """Those of ``present`` effects without which this one would not be the same: its lenders, and theirs."""
    from caphy.effects.registry import find_effect

    names = set(present)
    found = dict.fromkeys(effect.lenders(names) or ())
    left = list(found)
    while left:
        further = find_effect(left.pop()).lenders(names) or ()
        left += [name for name in further if name not in found]
        found |= dict.fromkeys(further)
    found.pop(effect.name, None)
    return tuple(found)


def needs(effect: Effect) -> str:
    """What a model must have beside an effect, in words."""
    return " and ".join(" or ".join(_alternatives(entry)) for entry in effect.borrows)


def lent(p: Values, owner: str) -> Values:
    """The parameters that another effect lends, under their own names; empty where the model lacks that effect."""
    return {key.removeprefix(f"{owner}."): value for key, value in p.items() if key.startswith(f"{owner}.")}


def gradient_jacobian(effect: Effect, e: Elements, p: Values) -> Tensor:
    """Hessian (k, 3, k, 3, ..., n) by automatic differentiation of a closed-form ``effect.gradient``."""
    x = e.x.detach().requires_grad_(True)
    with torch.enable_grad():
        _, gradient = effect.gradient(replace(e, x=x), p)
        rows = [
            torch.autograd.grad(gradient[vertex, axis].sum(), x, retain_graph=True)[0]
            for vertex in range(x.shape[0])
            for axis in range(3)
        ]
    return torch.stack(rows).reshape(x.shape[:2] + x.shape)


def clamp_eigenvalues(hessian: Tensor) -> Tensor:
    """Nearest positive semi-definite matrices of element Hessians (k, 3, k, 3, ..., n)."""
    size = hessian.shape[0] * 3
    flat = hessian.reshape(size, size, -1).permute(2, 0, 1)
    values, vectors = torch.linalg.eigh(0.5 * (flat + flat.mT))
    flat = (vectors * values.clamp_min(0)[:, None, :]) @ vectors.mT
    return flat.permute(1, 2, 0).reshape(hessian.shape)
