"""Tangents along a roll-out: how the motion changes with a model's numbers and with its start.

Each minimisation of the roll-out has g(x; step) = 0, so that a change of a number a or of the step's history moves it
by

    H dx = -dg/da - dg/d(step) d(step),

with the Hessian H factorised once for all columns. What happens between minimisations is linear, so the integrator
itself advances the tangents: it is called with tangents in the place of states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from torch import Tensor

from caphy.effects import past_kernels
from caphy.effects.base import HISTORY, BodyState, Elements, Step
from caphy.effects.bending_damping import BendingDamping
from caphy.effects.compiled import Loop
from caphy.effects.inertia import Inertia
from caphy.effects.potential import Potential, Term
from caphy.measure.mesh_body import MeshBody
from caphy.measure.scene import Scene
from caphy.refit.columns import Column, forces
from caphy.solve.body_motion import BodyMotion
from caphy.solve.integrators import Integrator, Solve, State
from caphy.solve.newton import Newton
from caphy.solve.rollout import Simulator

_NUDGE = 1e-9  # metres by which a history is moved to see what it does: friction bends within 1e-6
_FEW = 48  # columns up to which differences along each cost less than a matrix


Pushes = Callable[[Tensor, Step, BodyState | None], Tensor]
"""What K forces add to the gradient (K, S, V, 3) [N per unit] in S stages at once."""


@dataclass(frozen=True)
class Stage:
    """One minimisation of a roll-out: its step, its minimiser (V, 3) [m], and what that sees of the body."""

    step: Step
    x: Tensor
    body: BodyState | None


class Recorder:
    """An integrator that keeps the stages it went through."""

    def __init__(self, integrator: Integrator, motion: BodyMotion | MeshBody | None = None) -> None:
        self.integrator, self.motion, self.order = integrator, motion, integrator.order
        self.stages: list[Stage] = []

    def advance(self, state: State, dt: float, solve: Solve) -> State:
        """As the integrator would."""

        def kept(step: Step, time: float) -> Tensor:
            x = solve(step, time)
            # Asked for now, while the motion remembers that moment's body and most of the points nearest on it.
            body = None if self.motion is None else self.motion.state(time, x.numpy(), step.dt, float(step.lead))
            self.stages.append(Stage(replace(step, pressed=x), x, body))
            return x

        return self.integrator.advance(state, dt, kept)


@dataclass(frozen=True)
class Start:
    """Changes of the start state: positions and velocities (N, V, 3) per unit of each of N columns."""

    x: Tensor
    v: Tensor


class Tangents:
    """Tangents of roll-outs of one model on one scene."""

    def __init__(
        self,
        scene: Scene,
        newton: Newton,
        candidates: Potential,
        columns: Sequence[Column],
        pushes: Pushes | None = None,
    ) -> None:
        """``newton`` minimises the model; ``candidates`` is the model with the effects of all columns present.

        ``pushes`` gives further forces, of no effect, whose responses follow those of the columns.
        """
        self.scene, self.newton, self.candidates, self.columns = scene, newton, candidates, columns
        self.pushes = pushes
        self._read: dict[tuple[str, bool], tuple[str, ...]] = {}
        free = np.ones(len(scene.garment.vertices)) if scene.fixed is None else (~scene.fixed).astype(float)
        self._free = torch.from_numpy(free)[:, None]

    def along(
        self, stages: Sequence[Stage], start: Start | None, frames: int, substeps: int, integrator: Integrator
    ) -> np.ndarray:
        """Changes of the positions in each frame (frames + 1, K + N, V, 3) per unit of each column, start included."""
        dt = 1 / self.scene.measurement.fps
        pushes = self._pushes(stages)
        zeros = torch.zeros_like(pushes[0])
        state = State(0.0, zeros, zeros)
        if start is not None:
            state = State(0.0, torch.cat([zeros, start.x * self._free]), torch.cat([zeros, start.v * self._free]))
        if not len(state.x):
            return np.zeros((frames + 1, *state.x.shape))
        place = iter(range(len(stages)))

        def solve(change: Step, time: float) -> Tensor:
            i = next(place)
            return self._solved(stages[i], pushes[i], change)

        found = [state.x.numpy()]
        for _ in range(frames):
            for _ in range(substeps):
                state = integrator.advance(state, dt / substeps, solve)
            found.append(state.x.numpy())
        return np.stack(found)

    def _solved(self, stage: Stage, push: Tensor, change: Step) -> Tensor:
        right = self._of_history(stage, change)
        right[: len(push)] += push
        right = (right * self._free).permute(1, 2, 0).contiguous().numpy()  # (V, 3, K)
        body = stage.body
        factor = self.newton.factorize(stage.x, stage.step, None if body is None else lambda _: body)
        return torch.from_numpy(-factor.solve(right)).permute(2, 0, 1).contiguous()

    def _of_history(self, stage: Stage, change: Step) -> Tensor:
        """Change of the model's gradient (K, V, 3) with the step's history."""
        total, potential = torch.zeros_like(change.target), self.newton.potential
        for name, term in potential.present(stage.step, stage.body):
            if isinstance(term.effect, Inertia):
                total -= (term.rest["mass"] / change.dt**2)[:, None] * change.target
            elif isinstance(term.effect, BendingDamping) and (loop := potential.loop(term, stage.x, stage.step, None)):
                _of_damping(loop, stage, change, total)
            elif (term.effect.needs_step or term.effect.reads_step) and len(total) > _FEW:
                elements = potential.elements(term, stage.x, stage.step, stage.body)
                if (which := (name, float(stage.step.lead) != 0)) not in self._read:
                    self._read[which] = _read(term, elements)
                for field in self._read[which]:
                    by = getattr(change, field).numpy().reshape(len(total), -1)
                    matrix = _history_matrix(term, elements, field, len(stage.x))
                    total += torch.from_numpy((matrix @ by.T).T).reshape(total.shape)
            elif term.effect.needs_step or term.effect.reads_step:
                total += _along_history(potential, name, stage, change)
        return total

    def _pushes(self, stages: Sequence[Stage]) -> list[Tensor]:
        """What each column adds to the gradient in each stage, (K, V, 3) each; all stages at once."""
        if not self.columns and self.pushes is None:
            return [torch.zeros((0, *stages[0].x.shape), dtype=torch.float64)] * len(stages)
        fields = {name: torch.stack([getattr(s.step, name) for s in stages]) for name in HISTORY}
        times, lead = (
            torch.tensor([float(value) for value in values], dtype=torch.float64)[:, None]
            for values in zip(*((s.step.time, s.step.lead) for s in stages), strict=True)
        )
        x = torch.stack([s.x for s in stages])
        step = Step(stages[0].step.dt, **fields, time=times, pressed=x, lead=lead)
        bodies = [stage.body for stage in stages if stage.body is not None]
        body = None
        if bodies:
            body = BodyState(*(torch.stack([getattr(b, name) for b in bodies]) for name in vars(bodies[0])))
        found = [forces(self.candidates, self.columns, x, step, body)] if self.columns else []
        if self.pushes is not None:
            found.append(self.pushes(x, step, body).movedim(0, 1))
        return list(torch.cat(found, dim=1))


def _read(term: Term, e: Elements) -> tuple[str, ...]:
    """The fields of the history that an effect's energy asks for: its gradient can depend on no other."""
    asked = set()

    class Asked(Elements):
        def __getattribute__(self, name: str) -> object:
            asked.add(name)
            return super().__getattribute__(name)

    term.effect.energy(Asked(**vars(e)), term.values)
    return tuple(field for field in HISTORY if field in asked)


def _of_damping(loop: Loop, stage: Stage, change: Step, total: Tensor) -> None:
    """Add what changes of the history do to bending damping, which models that do not ring have, in closed form."""
    (start, lagged), (index, stiffness, length, area, lead) = loop.fields, loop.constants
    by_start, by_lagged = (field.contiguous().numpy() for field in (change.start, change.lagged))
    x = stage.x.numpy()[None]
    past_kernels.bending_damping(
        x, start, lagged, index, stiffness, length, area, lead, by_start, by_lagged, total.numpy()
    )


def _nudge(dt: float, field: str) -> float:
    return _NUDGE / dt if field == "lagged_velocity" else _NUDGE


def _along_history(potential: Potential, name: str, stage: Stage, change: Step) -> Tensor:
    """What K changes of the history do to one effect's gradient (K, V, 3), by differences along each of them."""
    by = {field: getattr(change, field) for field in HISTORY}  # (K, V, 3)
    nudges = torch.stack([value.abs().amax((1, 2)) / _nudge(stage.step.dt, field) for field, value in by.items()])
    nudges = nudges.amax(0)
    nudges = torch.where(nudges > 0, nudges, 1.0)[:, None, None]  # how many of them each change is
    wide = stage.x.expand(len(nudges) + 1, *stage.x.shape)  # the last is not nudged
    fields = {
        field: torch.cat([getattr(stage.step, field) + value / nudges, getattr(stage.step, field)[None]])
        for field, value in by.items()
    }
    step = replace(stage.step, **fields, pressed=_expanded(stage.step.pressed, wide))
    body = None if stage.body is None else stage.body.map(lambda field: field.expand(wide.shape))
    found = potential.term_gradient(name, wide, step, body)
    return (found[:-1] - found[-1]) * nudges


def _expanded(field: Tensor | None, like: Tensor) -> Tensor | None:
    return None if field is None else field.expand(like.shape)


def _history_matrix(term: Term, e: Elements, field: str, count: int) -> csr_array:
    """Derivative of one effect's gradient by a field of the history (3 V, 3 V), by differences in each element's own
    dozen coordinates."""
    corners, many = e.x.shape[0], e.x.shape[-1]
    basis = torch.eye(3 * corners, dtype=e.x.dtype).reshape(corners, 3, -1, 1)  # (k, 3, B, 1)

    def spread(value: Tensor) -> Tensor:
        return value[..., None, :].expand(*value.shape[:-1], basis.shape[2], many)

    body = None if e.body is None else {key: spread(value) for key, value in e.body.items()}
    fields = {name: spread(getattr(e, name)) for name in HISTORY}
    assert e.dt is not None
    nudge = _nudge(e.dt, field)
    pressed = None if e.pressed is None else spread(e.pressed)
    wide = replace(e, x=spread(e.x), body=body, pressed=pressed, **{**fields, field: fields[field] + nudge * basis})
    here, after = (term.effect.gradient(each, term.values)[1] for each in (e, wide))
    jacobian = ((after - here[:, :, None]) / nudge).flatten(0, 1)  # (k c, B, n)
    place = (3 * term.index.T[:, None, :] + torch.arange(3)[None, :, None]).flatten(0, 1)  # (k c, n)
    row, column = torch.broadcast_tensors(place[:, None], place[None])
    entries = (jacobian.numpy().ravel(), (row.numpy().ravel(), column.numpy().ravel()))
    return coo_array(entries, (3 * count, 3 * count)).tocsr()


def recorded_simulator(scene: Scene, newton: Newton, integrator: Integrator) -> tuple[Simulator, Recorder]:
    """A simulator of a scene that keeps its stages."""
    recorder = Recorder(integrator, scene.motion)
    return Simulator(newton, scene.motion, recorder, scene.pins), recorder  # type: ignore[arg-type]
