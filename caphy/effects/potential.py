"""The potential of a model on a piece of cloth: the plain sum of its effects, with gradient and Hessian."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import HISTORY, BodyState, Effect, Elements, Step, Values
from caphy.effects.cloth import Cloth
from caphy.effects.compiled import KERNELS, Arguments, Bound, Loop, Sums, accumulate
from caphy.effects.model import Model
from caphy.effects.registry import find_effect
from caphy.effects.trial import irregular_cloth, moment
from caphy.errors import CaphyError
from caphy.recorded import Recorded


@dataclass(frozen=True)
class Term:
    """One effect bound to a cloth: its elements, their constants and its parameter values."""

    effect: Effect
    index: Tensor
    """Vertex indices of the elements, (n, k)."""
    incidence: Tensor
    """For each vertex its (corner * n + element) slots, padded with k * n, (V, m): scatters as a gather."""
    rest: dict[str, Tensor]
    values: Values

    @property
    def is_off(self) -> bool:
        """Whether all coefficients of the effect are zero."""
        found = [self.values[key] for key in self.effect.coefficients]
        return bool(found) and not any(bool(value.any()) for value in found)

    def gather(self, planes: Tensor) -> Tensor:
        """Element positions (k, 3, ..., n) of vertex planes (3, ..., V)."""
        n, k = self.index.shape
        picked = planes.index_select(-1, self.index.T.reshape(-1))
        return picked.unflatten(-1, (k, n)).movedim(-2, 0)

    def scatter(self, forces: Tensor) -> Tensor:
        """Vertex sums (3, ..., V) of element quantities (k, 3, ..., n)."""
        flat = forces.movedim(0, -2).flatten(-2)
        padded = torch.nn.functional.pad(flat, (0, 1))
        slots = padded.index_select(-1, self.incidence.reshape(-1))
        return slots.unflatten(-1, tuple(self.incidence.shape)).sum(-1)


def _rest(effect: Effect, cloth: Cloth, count: int) -> dict[str, np.ndarray]:
    """What an effect says its elements are at rest; raises CaphyError unless it says it of each."""
    rest = effect.rest(cloth)
    if not isinstance(rest, dict):
        raise CaphyError(
            f"{effect.name}: rest(cloth) must return a dictionary, name -> array, got {type(rest).__name__}"
        )
    for key, value in rest.items():
        if np.shape(value)[-1:] not in ((count,), ()):
            raise CaphyError(
                f"{effect.name}: rest(cloth)[{key!r}] must have {count} entries along its last axis, "
                f"one for each {effect.element}, got shape {np.shape(value)}"
            )
    return rest


def _incidence(index: Tensor, vertex_count: int) -> Tensor:
    n, k = index.shape
    flat = index.T.reshape(-1)
    order = torch.argsort(flat, stable=True)
    counts = torch.bincount(flat, minlength=vertex_count)
    first = torch.cumsum(counts, 0) - counts
    place = torch.arange(len(flat)) - first[flat[order]]
    slots = torch.full((vertex_count, max(int(counts.max()), 1)), k * n)
    slots[flat[order], place] = order
    return slots


def planes(field: Tensor) -> Tensor:
    """Component-first contiguous planes (3, ..., V) of a vertex field (..., V, 3)."""
    return field.movedim(-1, 0).contiguous()


def _fields(step: Step | None, x: Tensor) -> list[Tensor]:
    """The tensors of a step in the order of its map, and its time as one."""
    fields: list[Tensor] = []
    if step is not None:
        step.map(lambda field: fields.append(field) or field)
        fields.append(torch.as_tensor(step.time, dtype=x.dtype, device=x.device))
    return fields


class Potential:
    """The incremental potential Phi of a model on a cloth.

    Positions are (..., V, 3) [m] with any leading axes (frames); energies come back as (...,) [J]. In statics
    (``step`` is None) effects that need motion are left out; without a body those that need one are. The area density
    is the model's, whatever the cloth came with.
    """

    def __init__(
        self,
        model: Model,
        cloth: Cloth,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> None:
        self.model, self.dtype, self.device = model, dtype, torch.device(device)
        self.cloth = cloth if cloth.density == model.density else replace(cloth, density=model.density)
        self.terms = {name: self._bind(name) for name in model.effects}
        self._histories: dict[str, tuple[Step, dict[str, Any]]] = {}
        self._loops: dict[str, tuple[tuple[Term, Step | None, BodyState | None], Loop]] = {}
        self._recorded: dict[tuple, Recorded] = {}

    def _bind(self, name: str) -> Term:
        effect = find_effect(name)

        def tensor(value: object) -> Tensor:
            return torch.as_tensor(value, dtype=self.dtype, device=self.device)

        index = torch.as_tensor(effect.index(self.cloth))
        if index.is_floating_point() or index.dtype == torch.bool:  # truths are not the vertices 0 and 1
            raise CaphyError(f"{name}: index must give numbers of vertices, whole ones, got {index.dtype}")
        index = index.to(torch.int64)
        values = {key: tensor(value) for key, value in self.model.effects[name].items()}
        for other in effect.lenders(self.model.effects) or ():
            values |= {f"{other}.{key}": tensor(value) for key, value in self.model.effects[other].items()}
        rest = {key: tensor(value) for key, value in _rest(effect, self.cloth, len(index)).items()}
        incidence = _incidence(index, len(self.cloth.vertices))
        return Term(effect, index.to(self.device), incidence.to(self.device), rest, values)

    def elements(self, term: Term, x: Tensor, step: Step | None, body: BodyState | None) -> Elements:
        """The elements of a term at positions (..., V, 3)."""

        def gathered(field: Tensor) -> Tensor:
            return term.gather(planes(field))

        moving = {}
        if step is not None and (term.effect.needs_step or term.effect.reads_step):
            moving = self._history(term, step)
        seen = None
        if body is not None and term.effect.needs_body:
            seen = {key: gathered(value)[0] for key, value in vars(body).items()}
        return Elements(gathered(x), term.rest, body=seen, **moving)

    def _history(self, term: Term, step: Step) -> dict[str, Any]:
        """What the elements of a term are told of a step; a solver asks for that of the same one again and again."""
        name = term.effect.name
        if (kept := self._histories.get(name)) is not None and kept[0] is step:
            return kept[1]
        fields = {key: term.gather(planes(getattr(step, key))) for key in HISTORY}
        pressed = None
        if step.pressed is not None and term.effect.needs_body:
            pressed = term.gather(planes(step.pressed))
        told = {"dt": step.dt, "time": step.time, "pressed": pressed, "lead": step.lead, "known": {}, **fields}
        if step.origin.dim() == 2:  # batches of frames take room, and come once
            self._histories[name] = step, told
        return told

    def acting(self, x: Tensor, step: Step | None, body: BodyState | None) -> Iterator[tuple[str, Term, Elements]]:
        """The terms that act in this situation with their elements."""
        for name, term in self.present(step, body):
            yield name, term, self.elements(term, x, step, body)

    def present(self, step: Step | None, body: BodyState | None) -> Iterator[tuple[str, Term]]:
        """The terms that act in this situation."""
        for name, term in self.terms.items():
            if (step is None and term.effect.needs_step) or (body is None and term.effect.needs_body):
                continue
            yield name, term

    def energies(self, x: Tensor, step: Step | None = None, body: BodyState | None = None) -> dict[str, Tensor]:
        """Energy of each effect [J], name -> (...,)."""
        return {
            name: term.effect.energy(elements, term.values).sum(-1)
            for name, term, elements in self.acting(x, step, body)
        }

    def gradient(self, x: Tensor, step: Step | None = None, body: BodyState | None = None) -> tuple[Tensor, Tensor]:
        """Total energy (...,) [J] and its gradient (..., V, 3) [N], history and body held fixed."""
        self._check(x)
        x = x.detach().contiguous()
        if x.device.type == "cpu":
            return self._summed(x, step, body)
        assert step is None or not isinstance(step.lead, Tensor)  # the network's steps have none
        kind = step and (step.dt, step.pressed is None, step.lead), body is None
        recorded = self._recorded.setdefault(kind, Recorded(partial(self._of_fields, step, body)))
        energy, gradient = recorded(x, *_fields(step, x), *(() if body is None else vars(body).values()))
        return energy, gradient

    def _of_fields(
        self, step: Step | None, body: BodyState | None, x: Tensor, *fields: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The gradient in a situation like that of ``step`` and ``body``, with these tensors in place of theirs."""
        left = iter(fields)
        if step is not None:
            step = replace(step.map(lambda _: next(left)), time=next(left))
        if body is not None:
            body = BodyState(*left)
        return self._summed(x, step, body)

    def _summed(self, x: Tensor, step: Step | None, body: BodyState | None) -> tuple[Tensor, Tensor]:
        return self._sum(self.present(step, body), x, step, body)

    def _sum(
        self, terms: Iterable[tuple[str, Term]], x: Tensor, step: Step | None, body: BodyState | None
    ) -> tuple[Tensor, Tensor]:
        """Energy (...,) and gradient (..., V, 3) of some terms together."""
        energy, gradient = x.new_zeros(x.shape[:-2]), torch.zeros_like(x)
        sums = Sums.of(x, energy, gradient) if x.device.type == "cpu" else None
        for _, term in terms:
            if sums is not None and (loop := self.loop(term, x, step, body)) is not None:
                accumulate(loop, sums)
                continue
            elements = self.elements(term, x, step, body)
            values, forces = term.effect.gradient(elements, term.values)
            energy += values.sum(-1)
            gradient += term.scatter(forces).movedim(0, -1)
        return energy, gradient

    def loop(self, term: Term, x: Tensor, step: Step | None, body: BodyState | None) -> Loop | None:
        """The kernel of a term at positions like x (..., V, 3) with all that it reads; None where it has none."""
        kernel = kernel_of(type(term.effect))
        if kernel is None:
            return None
        moving = term.effect.needs_step or term.effect.reads_step
        told = term, step if moving else None, body if term.effect.needs_body else None
        kept = self._loops.get(term.effect.name)
        if kept is not None and x.dim() == 2 and all(old is new for old, new in zip(kept[0], told, strict=True)):
            return kept[1]
        if (arguments := kernel(Bound(term.index, term.rest, term.values, *told[1:]))) is None:
            return None
        loop = Loop.of(arguments, x)
        if x.dim() == 2:  # batches of frames take room, and come once
            self._loops[term.effect.name] = told, loop
        return loop

    def term_gradients(self, x: Tensor, step: Step | None = None, body: BodyState | None = None) -> dict[str, Tensor]:
        """Gradient of each effect's energy [N], name -> (..., V, 3); they add up to :meth:`gradient`."""
        self._check(x)
        return {
            name: term.scatter(term.effect.gradient(elements, term.values)[1]).movedim(0, -1)
            for name, term, elements in self.acting(x.detach(), step, body)
        }

    def term_gradient(self, name: str, x: Tensor, step: Step | None, body: BodyState | None) -> Tensor:
        """Gradient of one effect's energy [N] at positions (..., V, 3) [m]."""
        self._check(x)
        return self._sum([(name, self.terms[name])], x.detach().contiguous(), step, body)[1]

    def parameter_gradients(
        self,
        x: Tensor,
        step: Step | None = None,
        body: BodyState | None = None,
        wanted: Collection[str] | None = None,
    ) -> dict[str, Tensor]:
        """Derivatives of the gradient with respect to parameters, "effect.parameter" -> (*parameter, ..., V, 3).

        Where the energy is linear in a parameter this is the effect's gradient per unit of it, which a compiled kernel
        tells where there is one. History and body are held fixed; effects that borrow a parameter contribute to its
        derivative, unless they are switched off. All else is automatic differentiation of the energies, so it holds for
        every effect.

        Args:
            x, step, body: the state, positions (..., V, 3) [m].
            wanted: parameters to differentiate by; all unless given.
        """
        self._check(x)
        totals: dict[str, Tensor] = {}
        for name, term in self.present(step, body):
            names = {key: key if "." in key else f"{name}.{key}" for key in term.values}
            if term.is_off:  # exerts nothing, whatever is lent to it
                names = {key: full for key, full in names.items() if "." not in key}
            keys = [key for key, full in names.items() if wanted is None or full in wanted]
            if not keys:
                continue
            elements = None
            for key in keys:
                mixed, full = self._per_unit(term, key, x.detach(), step, body), names[key]
                if mixed is None:
                    elements = elements or self.elements(term, x.detach(), step, body)
                    mixed = _mixed_derivative(term, elements, key)
                totals[full] = totals[full] + mixed if full in totals else mixed
        return totals

    def _per_unit(self, term: Term, key: str, x: Tensor, step: Step | None, body: BodyState | None) -> Tensor | None:
        """What one unit more of a parameter adds to the gradient, (*parameter, ..., V, 3); None where its energy is not
        linear in it, or no kernel says how."""
        own = term.effect.parameters.get(key)
        if own is None or not own.linear or x.device.type != "cpu" or self.loop(term, x, step, body) is None:
            return None
        value, x = term.values[key], x.contiguous()
        found, none = [], torch.zeros_like(value)
        for one in torch.eye(value.numel(), dtype=value.dtype).reshape(-1, *value.shape):
            others = (replace(term, values={**term.values, key: there}) for there in (none, one))
            without, with_it = (self._sum([("", other)], x, step, body)[1] for other in others)
            found.append(with_it - without)  # to a large value one more adds nothing
        return torch.stack(found).reshape(*value.shape, *x.shape)

    def _check(self, x: Tensor) -> None:
        """Raises ValueError on positions of another cloth, precision or device."""
        shape = (len(self.cloth.vertices), 3)
        if x.shape[-2:] != shape or x.dtype != self.dtype or x.device.type != self.device.type:
            raise ValueError(
                f"positions must be (..., {shape[0]}, 3) {self.dtype} on {self.device.type}, "
                f"got {tuple(x.shape)} {x.dtype} on {x.device.type}"
            )

    def loss(self, x: Tensor, step: Step | None = None, body: BodyState | None = None) -> Tensor:
        """Total energy (...,) [J], differentiable in ``x`` (only), through the effects' own gradients.

        The history is detached by construction: implicit Euler minimises over the new positions alone.
        """
        return _Loss.apply(x, self, step, body)  # pyright: ignore[reportReturnType]


def _mixed_derivative(term: Term, elements: Elements, key: str) -> Tensor:
    """Second derivative of a term's energy by a parameter and the positions, (*parameter, ..., V, 3)."""
    x = elements.x.detach().requires_grad_(True)
    value = term.values[key].detach().clone().requires_grad_(True)
    with torch.enable_grad():
        energy = term.effect.energy(replace(elements, x=x), {**term.values, key: value}).sum()
        (slope,) = torch.autograd.grad(energy, value, create_graph=True, materialize_grads=True)
        rows = [_slope(entry, x) for entry in slope.reshape(-1)]
    scattered = torch.stack([term.scatter(row).movedim(0, -1) for row in rows])
    return scattered.reshape(*value.shape, *scattered.shape[1:])


def _slope(value: Tensor, x: Tensor) -> Tensor:
    if not value.requires_grad:
        return torch.zeros_like(x)
    return torch.autograd.grad(value, x, retain_graph=True, materialize_grads=True)[0]


class _Loss(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, potential: Potential, step: Step | None, body: BodyState | None) -> Tensor:
        energy, gradient = potential.gradient(x, step, body)
        ctx.save_for_backward(gradient)
        return energy

    @staticmethod
    def backward(ctx, *upstream: Tensor):
        (gradient,) = ctx.saved_tensors
        return upstream[0][..., None, None] * gradient, None, None, None


@cache
def kernel_of(effect: type[Effect]) -> Callable[[Bound], Arguments | None] | None:
    """The kernel of an effect; None where there is none or where the effect's file says something else by now.

    The file of an effect rules. Whoever changes its formula gets what the formula says, more slowly, until the kernel
    is changed too; ``caphy effects check`` tells.
    """
    kernel = KERNELS.get(effect)
    return kernel if kernel is not None and _same(effect.name, kernel) else None


def _same(name: str, kernel: Callable[[Bound], Arguments | None]) -> bool:
    """Whether a kernel computes what an effect does, tried on a small shaken cloth."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), Potential(Model(cloth.density, {name: {}}), cloth)
    ((_, term, elements),) = potential.acting(at.x, at.step, at.body)
    energy, gradient = at.x.new_zeros(()), torch.zeros_like(at.x)
    arguments = kernel(Bound(term.index, term.rest, term.values, at.step, at.body))
    assert arguments is not None, f"the kernel of {name} must hold in a single frame"
    accumulate(Loop.of(arguments, at.x), Sums.of(at.x, energy, gradient))
    of_each, forces = term.effect.gradient(elements, term.values)
    wanted = term.scatter(forces).movedim(0, -1)
    energies = of_each.sum(), term.effect.energy(elements, term.values).sum()
    return all(torch.allclose(energy, other, rtol=1e-9, atol=0) for other in energies) and bool(
        (gradient - wanted).abs().max() <= 1e-9 * wanted.abs().max()
    )
