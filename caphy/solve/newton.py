"""Minimisation of an incremental potential by Newton's method with a line search; it says whether it converged."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from caphy.conventions import GRAVITY
from caphy.effects.base import BodyState, Step
from caphy.effects.body_contact import BodyContact, braked
from caphy.effects.potential import Potential
from caphy.effects.registry import file_of, find_effect
from caphy.errors import Diverged
from caphy.solve.assembly import Hessian
from caphy.solve.factorize import Factor

TOLERANCE = 5e-5
"""Largest component of the net force on any vertex at which a step counts as converged [N]."""

SAFE_TRAVEL = 0.01
"""A vertex may travel its distance to the body plus this in one iteration [m]: thinner than any limb."""

_OF_WEIGHT = 0.1  # of a vertex: the most that a tolerance may be where forces are to balance
_SUFFICIENT = 1e-4  # Armijo's fraction of the predicted decrease
_HALVINGS = 10
_LONGEST = 16
_SLOW = 0.5  # fall of the residual in one iteration that counts as slow
_LEAPS = 3  # steps that a minimisation may take without descent
_DIRECTIONS = np.float32  # precision of Newton directions: relative errors of 1e-4 do not cost an iteration
_NEAR = 150  # times the tolerance: the residual from which on the last factor is tried again, at a tenth of the cost
_HANDED = 400  # the same of one that an earlier minimisation made
_FALLS = 0.5  # by which it must fall with that, or else a new one comes next
_STATIC_NEAR, _STATIC_FALLS = 40, 0.3  # in statics; what does not fall by that is not gone to
_MEMORY = 8  # moves that an earlier factor is corrected along
_BEYOND = 0.1  # of the tolerance: where to a time step goes on while an earlier factor helps
_HARDEST = 1e30  # damping [1/s^2] beyond which a Hessian is not indefinite but no number
_HELD = 3.0  # times its inertia: what holds a vertex that is pressed into the body, elasticity included
_PROJECTIONS = (1e-6, 0.5, 1.0)  # tried one after the other; the first is exact but for contact inside the body

Body = Callable[[Tensor], BodyState]
"""What positions (V, 3) [m] see of the body at the time of the step."""

_STILL = 2e-3  # a vertex keeps its contact plane until it has moved this far [m] ...
_GROWTH = 2  # ... and this many times farther before each further renewal
_TURN, _RADIUS = 0.02, 5e-3  # a normal may turn this far, plus one radian per move of this many metres
_MOST = 0.5  # however far the vertex moved
_SETTLING = 1000  # times the tolerance: the residual at which planes are renewed first
_SETTLED = 1e-5  # of vertices that have moved farther than this since [m]; then again at convergence, in statics
_STATIC_SETTLING = 0.1  # whenever the residual has fallen to this share of what the last renewal made of it:
_RENEWALS, _STATIC_RENEWALS = 1, 60  # so often at most, after the first


@dataclass(frozen=True)
class Report:
    """How a minimisation ended.

    Attributes:
        converged: the residual is within the tolerance.
        iterations: Newton iterations taken.
        residual: largest component of the net force on any free vertex [N].
        reason: why it stopped, in words.
    """

    converged: bool
    iterations: int
    residual: float
    reason: str


@dataclass(frozen=True)
class _Point:
    """A trial state and what the potential says of it."""

    x: Tensor
    body: BodyState | None
    energy: float
    gradient: np.ndarray

    @property
    def residual(self) -> float:
        return float(np.abs(self.gradient).max())


class _Planes:
    """The contact planes of one minimisation, which follow the cloth but do not jump.

    The distance to a body has creases where two surfaces are equally near, as in an armpit or along the concave edges
    of its mesh. The minimum of a penalty likes to lie right on a crease, where its gradient jumps and no method that
    looks for zero gradient can settle; and cloth pinched there would be handed from one side to the other. Planes
    are therefore kept during a line search, and afterwards renewed where a vertex has moved and its normal has
    turned no more than the move explains. Off the creases they are the true tangent planes at convergence.
    """

    def __init__(self, body: Body | None, x: Tensor, due: float) -> None:
        self._body, self._x = body, x
        self.due = due
        """Residual at which they are to settle [N]."""
        self.state = None if body is None else body(x)
        self._settled, self._least = 0, x.new_full((len(x),), _STILL)

    def follow(self, x: Tensor) -> bool:
        """Renew planes of vertices that have moved far enough; tells whether there were any.

        The more often a plane is renewed the farther its vertex must move for the next, so that no cycle lasts.
        """
        return self._renew(x, self._least)

    def settle(self, x: Tensor, renewals: int) -> bool:
        """Renew planes, once and then ``renewals`` times at most; tells whether any was."""
        if self._settled > renewals:
            return False
        self._settled += 1
        self._least = torch.full_like(self._least, _STILL)
        return self._renew(x, torch.full_like(self._least, _SETTLED))

    def _renew(self, x: Tensor, least: Tensor) -> bool:
        if self._body is None or self.state is None:
            return False
        moved = (x - self._x).norm(dim=1)
        if not (moved > least).any():
            return False
        found = self._body(torch.where((moved > least)[:, None], x, self._x))
        turned = (found.normal - self.state.normal).norm(dim=1)
        new = (moved > least) & (turned <= torch.clamp(_TURN + moved / _RADIUS, max=_MOST))
        self._least = torch.where(new, _GROWTH * self._least, self._least)
        fields = {
            name: torch.where(new[:, None], value, getattr(self.state, name)) for name, value in vars(found).items()
        }
        self.state, self._x = BodyState(**fields), torch.where(new[:, None], x, self._x)
        return bool(new.any())


class Curvature:
    """A Hessian factorised a while ago, and what gradients have told since of how it has changed.

    Its inverse is that of the factor, corrected along the moves since (L-BFGS: Nocedal, Math. Comp. 35, 1980). One
    that is handed from minimisation to minimisation of the same step length saves most of the factorisations.
    """

    def __init__(self) -> None:
        self._factor: Factor | None = None
        self._told: list[tuple[np.ndarray, np.ndarray, float]] = []
        self._tired, self._dt, self.reach = False, 0.0, 0

    def begin(self, step: Step | None) -> None:
        """Be ready for a minimisation; what was known for another step length is forgotten."""
        dt = 0.0 if step is None else step.dt
        if step is None or dt != self._dt:
            self._factor = None
        self._dt, self._tired, self.reach = dt, False, _HANDED

    def renew(self, factor: Factor) -> None:
        """Go by another factor."""
        self._factor, self._told, self._tired, self.reach = factor, [], False, _NEAR

    @property
    def helps(self) -> bool:
        """Whether it is known, and took enough of the residual away when last asked."""
        return self._factor is not None and not self._tired

    def learn(self, before: _Point, after: _Point) -> None:
        """Take it that the gradient changes from one point to another as it does."""
        self._tired = not after.residual <= _FALLS * before.residual
        move, change = (after.x - before.x).numpy(), after.gradient - before.gradient
        if (product := float((move * change).sum())) > 0:
            self._told = [*self._told[1 - _MEMORY :], (move, change, product)]

    def solve(self, gradient: np.ndarray) -> np.ndarray:
        """The move (V, 3) [m] that a gradient (V, 3) [N] asks for."""
        assert self._factor is not None
        left, shares = gradient.copy(), []
        for move, change, product in reversed(self._told):
            shares.append(float((move * left).sum()) / product)
            left -= shares[-1] * change
        found = self._factor.solve(left)
        for (move, change, product), share in zip(self._told, reversed(shares), strict=True):
            found += (share - float((change * found).sum()) / product) * move
        return -found


class Newton:
    """Newton's method for the potential of one garment; everything symbolic is prepared once.

    The Hessian is the exact one where that is positive definite, which takes the fewest iterations (Longva et al.,
    Pitfalls of projection, 2023); otherwise, and after a step that had to be shortened, compressed faces and bent
    hinges are made half or wholly semi-definite (Teran et al., SCA 2005), so that every direction is one of descent.
    Directions are damped by mass where the Hessian is singular (statics).
    """

    def __init__(
        self,
        potential: Potential,
        fixed: np.ndarray | None = None,
        tolerance: float = TOLERANCE,
        max_iterations: int = 100,
    ) -> None:
        """``fixed`` (V,) marks vertices that stay where the guess has them; ``tolerance`` in newtons."""
        self.potential, self.tolerance, self.max_iterations = potential, tolerance, max_iterations
        self.fixed = fixed
        self.hessian = Hessian(potential, fixed)
        self._free = None if fixed is None else (~fixed).astype(float)[:, None]
        self._mass = potential.cloth.mass

    def within(self, tolerance: float) -> Newton:
        """The same solver with another tolerance [N]; everything prepared is shared."""
        other = copy(self)
        other.tolerance = tolerance
        return other

    def resolving(self) -> Newton:
        """The same solver with a tolerance of at most a tenth of what a vertex weighs in the median.

        With more, fine cloth that hangs nowhere yet would count as at rest: no vertex weighs as much as the tolerance.
        """
        weight = float(np.median(self._mass)) * float(np.linalg.norm(GRAVITY))
        return self.within(min(self.tolerance, _OF_WEIGHT * weight))

    def minimise(
        self,
        guess: Tensor,
        step: Step | None,
        body: Body | None = None,
        damping: float = 0.0,
        least: int = 0,
        curvature: Curvature | None = None,
    ) -> tuple[Tensor, Report]:
        """The minimiser (V, 3) [m] reached from a guess.

        Args:
            guess: positions to start from (V, 3) [m].
            step: the step of the dynamics; None in statics.
            body: the body at that time; None without one.
            damping: mass-proportional damping of the first iteration [1/s^2]; fades while steps succeed.
            least: iterations to take whatever the residual. A guess that knows nothing of the forces is within the
                tolerance wherever vertices are so light that all forces on them are.
            curvature: what an earlier minimisation left, and this one leaves to the next.

        Raises:
            Diverged: the guess, its energy or the slope of its forces is not finite.
        """
        curvature = Curvature() if curvature is None else curvature
        curvature.begin(step)
        planes = _Planes(body, guess, _SETTLING * self.tolerance)
        here = self._evaluate(guess, step, planes.state)
        if not (np.isfinite(here.energy) and np.isfinite(here.gradient).all()):
            raise Diverged(self._why_not(here, step))
        level, leaps = 0, 0
        for iteration in range(self.max_iterations):
            if here.residual <= max(planes.due, self.tolerance):
                here = self._settled(here, step, planes)
            done = here.residual <= self.tolerance and iteration >= least
            if (there := self._by_earlier(curvature, here, step, done)) is not None:
                here = there if done else self._followed(there, step, planes)
                continue
            if done:
                return here.x, Report(True, iteration, here.residual, "converged")
            factor, damping, level = self._factor(here, step, damping, level)
            curvature.renew(factor)
            direction, fraction = _safe(here, -factor.solve(here.gradient))
            if iteration == 0:
                direction = self._braked(here, direction, step)
            there, fraction = self._search(here, direction, fraction, step)
            if there is None and level < len(_PROJECTIONS) - 1:
                level += 1
                continue
            if there is None and leaps < _LEAPS and step is not None:
                leaps += 1
                there, fraction = self._evaluate(here.x + 0.5 * torch.from_numpy(direction), step, here.body), 0.5
                there = there if np.isfinite(there.energy) and np.isfinite(there.gradient).all() else None
            if there is None:
                if damping > 1e12:
                    return here.x, Report(False, iteration, here.residual, "no descent: the energy is not smooth here")
                damping = max(100 * damping, 1.0)
                continue
            if fraction >= 1:
                damping, level = damping / 4 if damping > 1e-6 else 0.0, max(level - 1, 0)
            else:
                level = min(level + 1, len(_PROJECTIONS) - 1)
            here = self._followed(there, step, planes)
        converged = here.residual <= self.tolerance
        reason = "converged" if converged else f"stopped after {self.max_iterations} iterations"
        return here.x, Report(converged, self.max_iterations, here.residual, reason)

    def factorize(self, x: Tensor, step: Step | None, body: Body | None = None) -> Factor:
        """The factorised Hessian at positions (V, 3) [m], for tangents of the converged step.

        Exact where it is positive definite (as at a proper minimum), otherwise projected as little as makes it so.
        """
        state = None if body is None else body(x)
        for projection in (0.0, *_PROJECTIONS[:-1]):
            factor = self.hessian.factorize(self.hessian.values(x, step, state, projection))
            if factor is not None:
                return factor
        return self._damped(self.hessian.values(x, step, state), 0.0)[0]

    def _evaluate(self, x: Tensor, step: Step | None, state: BodyState | None) -> _Point:
        energy, gradient = self.potential.gradient(x, step, state)
        forces = gradient.numpy()
        return _Point(x, state, float(energy), forces if self._free is None else forces * self._free)

    def _why_not(self, here: _Point, step: Step | None) -> str:
        """What is not finite at a state, in words."""
        must = "the state to start from must be finite, with finite energy"
        if not bool(here.x.isfinite().all()):
            return f"{must}; check pose, garment and model"
        energies = self.potential.energies(here.x, step, here.body)
        wrong = [name for name, energy in energies.items() if not bool(energy.isfinite())]
        own = [f"{name} in {file}" for name in wrong if (file := file_of(name)) is not None]
        check = (
            f"look for what is not defined for this cloth in {' and '.join(own)}"
            if own
            else "check pose, garment and model"
        )
        return f"{must}, but {' and '.join(wrong) or 'a force'} is not there; {check}"

    def _followed(self, there: _Point, step: Step | None, planes: _Planes) -> _Point:
        """A trial state as it is seen once contact planes have followed it."""
        return self._evaluate(there.x, step, planes.state) if planes.follow(there.x) else there

    def _settled(self, here: _Point, step: Step | None, planes: _Planes) -> _Point:
        """A state as it is seen once contact planes have settled."""
        if planes.settle(here.x, _STATIC_RENEWALS if step is None else _RENEWALS):
            here = self._evaluate(here.x, step, planes.state)
        planes.due = _STATIC_SETTLING * here.residual if step is None else 0.0
        return here

    def _by_earlier(self, curvature: Curvature, here: _Point, step: Step | None, done: bool) -> _Point | None:
        """Where an earlier factor leads from near the minimum; None where it does not help, or enough is ``done``."""
        reach = _STATIC_NEAR if step is None else curvature.reach
        if not curvature.helps or here.residual > reach * self.tolerance:
            return None
        if done and (step is None or here.residual <= _BEYOND * self.tolerance):
            return None
        there = self._evaluate(here.x + torch.from_numpy(curvature.solve(here.gradient)), step, here.body)
        if step is None:
            return there if there.residual <= _STATIC_FALLS * here.residual else None
        curvature.learn(here, there)
        falls = there.residual < here.residual and there.energy <= here.energy + _rounding(here)
        return there if falls else None

    def _braked(self, here: _Point, direction: np.ndarray, step: Step | None) -> np.ndarray:
        """A direction (V, 3) [m] that leaves no vertex deep in the body, which it may know nothing of yet.

        Each iteration would halve the depth only. Later ones are left as they are: what holds a vertex by then is the
        cloth around it more than its own inertia.
        """
        contact = self.potential.terms.get(BodyContact.name)
        if contact is None or here.body is None or step is None:
            return direction
        hold = torch.from_numpy(_HELD / step.dt**2 * self._mass)
        elements = self.potential.elements(contact, here.x, step, here.body)
        shorter = braked(elements, contact.values, torch.from_numpy(direction).T, hold).T.numpy()
        return shorter if (here.gradient * shorter).sum() < 0 else direction

    def _factor(self, here: _Point, step: Step | None, damping: float, level: int) -> tuple[Factor, float, int]:
        """The factorised Hessian at a point, with the damping and the level of projection that it needed."""
        for projection in _PROJECTIONS[level:] if damping == 0 else ():
            factor = self.hessian.factorize(self.hessian.values(here.x, step, here.body, projection), _DIRECTIONS)
            if factor is not None:
                return factor, damping, _PROJECTIONS.index(projection)
        factor, damping = self._damped(self.hessian.values(here.x, step, here.body), damping)
        return factor, damping, len(_PROJECTIONS) - 1

    def _damped(self, values: np.ndarray, damping: float) -> tuple[Factor, float]:
        """The factor of the Hessian with just enough mass-proportional damping to be positive definite."""
        while True:
            shifted = self.hessian.shifted(values, damping * self._mass) if damping > 1e-6 else values
            factor = self.hessian.factorize(shifted)
            if factor is not None:
                return factor, damping
            if damping > _HARDEST:
                raise Diverged(self._why(values))
            damping = max(10 * damping, 1e-3)

    def _why(self, values: np.ndarray) -> str:
        """Why no damping is enough, in words."""
        if np.isfinite(values).all():
            negative = [
                f"{name}.{key}"
                for name, given in self.potential.model.effects.items()
                for key, value in given.items()
                if key in find_effect(name).coefficients and not np.ndim(value) and value < 0
            ]
            of = f" (it has a negative {' and '.join(negative)})" if negative else ""
            return f"the energy falls without bound: no stiffness or mass of the model may outweigh the rest{of}"
        return (
            "forces must have a finite slope where their energy is finite, but have none here: look for a root or a "
            "quotient of nothing in effects of your own (caphy effects check); check pose and garment"
        )

    def _search(
        self, here: _Point, direction: np.ndarray, fraction: float, step: Step | None
    ) -> tuple[_Point | None, float]:
        """The first halving of a step that lowers the energy enough (Armijo), and its fraction.

        Where progress is slow (cloth about to buckle) full steps are doubled while that lowers the energy further:
        an evaluation costs a tenth of an iteration.
        """
        slope = float((here.gradient * direction).sum())
        rounding = _rounding(here)
        move = torch.from_numpy(direction)
        for _ in range(_HALVINGS):
            there = self._evaluate(here.x + fraction * move, step, here.body)
            if there.energy <= here.energy + _SUFFICIENT * fraction * slope + rounding:
                break
            fraction /= 2
        else:
            return None, 0.0
        while 1 <= fraction < _LONGEST and there.residual > _SLOW * here.residual:
            farther = self._evaluate(here.x + 2 * fraction * move, step, here.body)
            if not farther.energy < there.energy:
                break
            there, fraction = farther, 2 * fraction
        return there, fraction


def _rounding(here: _Point) -> float:
    """What rounding may do to an energy [J]."""
    return 1e-13 * max(abs(here.energy), 1.0)


def _safe(here: _Point, direction: np.ndarray) -> tuple[np.ndarray, float]:
    """A direction (V, 3) [m] and the fraction of it along which no vertex can pass through the body.

    Vertices that would go too far are stopped, each for itself, as long as that leaves a direction of descent.
    """
    if here.body is None:
        return direction, 1.0
    room = np.linalg.norm(here.x.numpy() - here.body.point.numpy(), axis=1) + SAFE_TRAVEL
    share = np.minimum(1, room / np.maximum(np.linalg.norm(direction, axis=1), 1e-12))
    stopped = share[:, None] * direction
    if (here.gradient * stopped).sum() < 0:
        return stopped, 1.0
    return direction, float(share.min())
