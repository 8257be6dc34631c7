"""What every effect must satisfy, whoever wrote it: one function per property, each raising AssertionError.

The derivatives are compared with finite differences of the energy, the units by measuring the same cloth in other
units, the rest by symmetry. The tests run it on every registered effect and ``caphy effects check`` on a user's file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from caphy.effects.base import BodyState, Effect, Parameter, Step, companions
from caphy.effects.cloth import Cloth
from caphy.effects.compiled import KERNELS
from caphy.effects.model import Model, ParameterValues
from caphy.effects.potential import Potential, kernel_of
from caphy.effects.registry import find_effect
from caphy.effects.trial import DT, Moment, flat_cloth, irregular_cloth, moment, pleated_cloth
from caphy.effects.units import dimensions
from caphy.errors import CaphyError


def _potential(name: str, cloth: Cloth, dtype: torch.dtype = torch.float64, **values: Any) -> Potential:
    """The effect alone on a cloth, with what it borrows from left out of the sums."""
    borrowed: dict[str, Any] = {other: {} for other in companions(find_effect(name))}
    model = Model(cloth.density, {**borrowed, name: values})
    potential = Potential(model, cloth, dtype)
    potential.terms = {name: potential.terms[name]}
    return potential


def _energy(name: str, cloth: Cloth, at: Moment, **values: Any) -> float:
    return float(_potential(name, cloth, **values).energies(at.x, at.step, at.body)[name].sum())


def _close(got: Tensor, wanted: Tensor, what: str, relative: float) -> None:
    scale = float(wanted.abs().max())
    error = float((got - wanted).abs().max())
    assert error <= relative * scale + 1e-300, (
        f"{what}: off by {error:g}, {error / max(scale, 1e-300):.1e} of {scale:g}"
    )


def documented(name: str) -> None:
    """Default-constructible; docstring gives the energy's unit; reference, and unit and meaning of each parameter."""
    effect = find_effect(name)
    assert effect.name == name
    assert "[J]" in (type(effect).__doc__ or ""), "the docstring must give the energy's formula and unit, [J]"
    assert len(effect.reference) > 10, "reference must cite where the effect comes from"
    for key, parameter in effect.parameters.items():
        assert parameter.unit and parameter.doc, f"{key} must have a unit and a line of documentation"


def finite(name: str) -> None:
    """Finite and not idle on a shaken cloth."""
    cloth = irregular_cloth()
    at = moment(cloth)
    energy, gradient = _potential(name, cloth).gradient(at.x, at.step, at.body)
    assert bool(energy.isfinite()) and bool(gradient.isfinite().all()), "energy and gradient must be finite"
    assert float(gradient.abs().max()) > 0, "the effect must act on a shaken cloth"


def batch_equals_loop(name: str) -> None:
    """A batch of frames gives what the frames give one by one."""
    cloth = irregular_cloth()
    at, potential = moment(cloth, (2, 3)), _potential(name, cloth)
    energy, gradient = potential.gradient(at.x, at.step, at.body)
    assert energy.shape == (2, 3) and gradient.shape == at.x.shape
    (_, term, elements), *_ = potential.acting(at.x, at.step, at.body)
    hessian = term.effect.hessian(elements, term.values)
    for i in range(2):
        for j in range(3):
            one = at.frame(i).frame(j)
            alone = potential.gradient(one.x, one.step, one.body)
            _close(energy[i, j], alone[0], f"energy of frame {i, j}", 1e-12)
            _close(gradient[i, j], alone[1], f"gradient of frame {i, j}", 1e-12)
            (_, _, single), *_ = potential.acting(one.x, one.step, one.body)
            wanted = term.effect.hessian(single, term.values)
            _close(hessian[..., i, j, :].expand_as(wanted), wanted, f"Hessian of frame {i, j}", 1e-12)


def elements_are_their_own(name: str) -> None:
    """Where other elements are moved, an element keeps its energy: a Hessian is made of elements one by one."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    (_, term, elements), *_ = potential.acting(at.x, at.step, at.body)
    moved = elements.x.clone()
    moved[..., ::2] += 0.01 * torch.sin(torch.arange(float(moved[..., ::2].numel()))).reshape(moved[..., ::2].shape)
    before = term.effect.energy(elements, term.values)[..., 1::2]
    after = term.effect.energy(replace(elements, x=moved), term.values)[..., 1::2]
    _close(after, before, "energy of elements that stay where they are while others move", 1e-12)


def single_precision(name: str) -> None:
    """float32 stays near float64."""
    cloth = irregular_cloth()
    at = moment(cloth, (2,))
    double = _potential(name, cloth).gradient(at.x, at.step, at.body)
    low = at.to(torch.float32)
    single = _potential(name, cloth, torch.float32).gradient(low.x, low.step, low.body)
    _close(single[0].double(), double[0], "energy", 1e-3)
    _close(single[1].double(), double[1], "gradient", 1e-3)


def kernel_agrees(name: str) -> None:
    """The compiled loop, where there is one, computes what the effect's own formulas do."""
    effect = type(find_effect(name))
    assert effect not in KERNELS or kernel_of(effect) is not None, (
        f"{effect.__module__} and its compiled loop ({KERNELS[effect].__name__} in {KERNELS[effect].__module__}) "
        "compute different things; the loop is not used, which takes longer: change it too"
    )


def gradient_is_slope(name: str) -> None:
    """The gradient, generic and compiled, against central differences of the energy, and through the loss."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    _, gradient = potential.gradient(at.x, at.step, at.body)
    h = 1e-6
    offset = h * torch.eye(at.x.numel(), dtype=torch.float64).reshape(-1, *at.x.shape)
    ahead = potential.energies(at.x + offset, *_repeated(at, len(offset)))[name]
    behind = potential.energies(at.x - offset, *_repeated(at, len(offset)))[name]
    slope = ((ahead - behind) / (2 * h)).reshape(at.x.shape)
    _close(gradient, slope, "gradient against differences", 1e-5)
    (_, term, elements), *_ = potential.acting(at.x, at.step, at.body)
    values, forces = term.effect.gradient(elements, term.values)
    _close(values, term.effect.energy(elements, term.values), "energy returned by gradient()", 1e-12)
    _close(term.scatter(forces).movedim(0, -1), gradient, "gradient() against the compiled loop", 1e-10)
    x = at.x.clone().requires_grad_(True)
    (2 * potential.loss(x, at.step, at.body)).backward()
    assert x.grad is not None
    _close(x.grad, 2 * gradient, "gradient of the loss", 1e-14)


def _repeated(at: Moment, count: int) -> tuple[Step, BodyState]:
    many = at.map(lambda field: field.expand(count, *field.shape))
    return many.step, many.body


def hessian_is_slope(name: str) -> None:
    """The element Hessian against central differences of the element gradient; symmetric."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    (_, term, elements), *_ = potential.acting(at.x, at.step, at.body)
    hessian = term.effect.hessian(elements, term.values)
    h = 1e-7
    columns = []
    for vertex in range(len(elements.x)):
        for axis in range(3):
            offset = torch.zeros_like(elements.x)
            offset[vertex, axis] = h
            ahead, behind = (
                term.effect.gradient(replace(elements, x=x), term.values)[1]
                for x in (elements.x + offset, elements.x - offset)
            )
            columns.append((ahead - behind) / (2 * h))
    slope = torch.stack(columns).reshape(elements.x.shape[:2] + elements.x.shape)
    scale = float(slope.abs().max())
    assert float((hessian - slope).abs().max()) <= 1e-5 * scale, (
        f"Hessian off differences by {float((hessian - slope).abs().max()):g} of {scale:g}"
    )
    swapped = hessian.permute(2, 3, 0, 1, *range(4, hessian.dim()))
    assert float((hessian - swapped).abs().max()) <= 1e-9 * scale, "the Hessian must be symmetric"


def projection_is_semidefinite(name: str) -> None:
    """No projected element Hessian has a negative eigenvalue, and none vanishes where the Hessian is definite."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    (_, term, elements), *_ = potential.acting(at.x, at.step, at.body)
    exact = term.effect.hessian(elements, term.values)
    size = exact.shape[0] * 3
    projected = term.effect.projected_hessian(elements, term.values).reshape(size, size, -1).permute(2, 0, 1)
    exact = exact.reshape(size, size, -1).permute(2, 0, 1)
    values = torch.linalg.eigvalsh(projected)
    assert float(values.min()) >= -1e-9 * max(float(values.max()), 1e-300), f"eigenvalue {float(values.min()):g}"
    largest = torch.linalg.eigvalsh(exact)[:, -1]
    assert bool((values[:, -1] >= 0.2 * largest).all()), "the projection must keep the stiff directions"


def _turned(at: Moment, rotation: Tensor, shift: Tensor) -> Moment:
    """A moment seen after a rotation and a shift of everything."""
    step, body = at.step, at.body
    points = [x @ rotation.T + shift for x in (at.x, step.origin, step.target, step.lagged, body.point, body.anchor)]
    vectors = [x @ rotation.T for x in (step.lagged_velocity, body.normal, body.velocity)]
    return Moment(
        points[0],
        Step(step.dt, points[1], points[2], points[3], vectors[0], step.time),
        BodyState(points[4], vectors[1], vectors[2], points[5]),
    )


def same_in_every_frame(name: str) -> None:
    """Turning cloth, history and body together changes no energy."""
    cloth = irregular_cloth()
    at = moment(cloth)
    angle = torch.tensor(1.1, dtype=torch.float64)
    c, s, o, one = torch.cos(angle), torch.sin(angle), torch.zeros_like(angle), torch.ones_like(angle)
    rotation = torch.stack([c, -s, o, s, c, o, o, o, one]).reshape(3, 3) @ torch.stack(
        [one, o, o, o, c, s, o, -s, c]
    ).reshape(3, 3)
    turned = _turned(at, rotation, torch.zeros(3, dtype=torch.float64))
    before, after = _energy(name, cloth, at), _energy(name, cloth, turned)
    said = f"energy {before:.15g} J became {after:.15g} J; are all numbers of double precision?"
    assert abs(after - before) <= 1e-9 * abs(before), said


def same_in_every_place(name: str) -> None:
    """Shifting cloth, history and body together changes no force."""
    cloth, potential = irregular_cloth(), _potential(name, irregular_cloth())
    at = moment(cloth)
    there = _turned(at, torch.eye(3, dtype=torch.float64), torch.tensor((0.3, -0.2, 0.5), dtype=torch.float64))
    before, after = (potential.gradient(each.x, each.step, each.body)[1] for each in (at, there))
    _close(after, before, "force in another place (what is not to be differentiated reads e.lagged_velocity)", 1e-9)


def no_net_force(name: str) -> None:
    """An internal effect exerts no net force and no net torque."""
    if not find_effect(name).internal:
        return
    cloth = irregular_cloth()
    at = moment(cloth)
    _, gradient = _potential(name, cloth).gradient(at.x, at.step, at.body)
    force, torque = gradient.sum(0), torch.linalg.cross(at.x, gradient).sum(0)
    size = float(gradient.abs().sum())
    assert float(force.abs().max()) <= 1e-12 * size, f"net force {force.tolist()} N"
    assert float(torque.abs().max()) <= 1e-12 * size, f"net torque {torque.tolist()} N m"


def rests_at_rest(name: str) -> None:
    """An internal effect has neither energy nor force where the cloth lies as its template, even a folded one."""
    if not find_effect(name).internal:
        return
    for cloth in (flat_cloth(), pleated_cloth()):
        x = torch.as_tensor(cloth.vertices)
        at = moment(cloth)
        still = Step.implicit_euler(DT, x, x)
        potential = _potential(name, cloth)
        stirred = potential.gradient(at.x, at.step, at.body)
        energy, gradient = potential.gradient(x, still, at.body)
        assert abs(float(energy)) <= 1e-12 * abs(float(stirred[0])), f"rest energy {float(energy):g} J"
        assert float(gradient.abs().max()) <= 1e-10 * float(stirred[1].abs().max()), "there must be no force at rest"


def units_fit(name: str) -> None:
    """Measured in other units of mass, length and time, the energy is the same energy."""
    mass, length, time = 3.0, 2.0, 0.5
    cloth, effect = irregular_cloth(), find_effect(name)
    at = moment(cloth)

    def factor(unit: str) -> float:
        powers = dimensions(unit)
        return mass ** powers[0] * length ** powers[1] * time ** powers[2]

    def scaled(owner: Effect) -> ParameterValues:
        return {key: np.asarray(p.default) * factor(p.unit) for key, p in owner.parameters.items()}

    step, body = at.step, at.body
    speed = length / time
    other = Moment(
        length * at.x,
        Step(
            time * step.dt,
            length * step.origin,
            length * step.target,
            length * step.lagged,
            speed * step.lagged_velocity,
            time * step.time,
        ),
        BodyState(length * body.point, body.normal, speed * body.velocity, length * body.anchor),
    )
    scaled_cloth = Cloth(
        length * cloth.vertices,
        cloth.faces,
        length * cloth.material,
        cloth.density * factor("kg/m^2"),
        length * cloth.layer_thickness,
        cloth.attached,
    )
    potential = _potential(name, scaled_cloth)
    values = {key: torch.as_tensor(value) for key, value in scaled(effect).items()}
    for owner in companions(effect):
        values |= {f"{owner}.{key}": torch.as_tensor(v) for key, v in scaled(find_effect(owner)).items()}
    term = replace(potential.terms[name], values=values)
    got = float(term.effect.energy(potential.elements(term, other.x, other.step, other.body), values).sum())
    wanted = _energy(name, cloth, at) * factor("J")
    assert abs(got - wanted) <= 1e-9 * abs(wanted), f"energy is {got / wanted:g} times what its units say"


def refinement_converges(name: str) -> None:
    """On ever finer meshes of the same cloth in the same smooth motion, the energy settles."""
    energies = []
    for fineness in (2, 4, 8):
        cloth = flat_cloth(6 * fineness, 5 * fineness)
        x = torch.as_tensor(cloth.vertices)
        u, v = x[:, 0] / 0.12, x[:, 1] / 0.1

        def field(phase: float, u: Tensor = u, v: Tensor = v) -> Tensor:
            return torch.stack(
                [torch.sin(3 * u + phase), torch.cos(2 * v - phase), torch.sin(4 * u + 3 * v + phase)], 1
            )

        previous, before = x + 0.003 * field(0.3), x + 0.003 * field(0.1)
        normal = torch.nn.functional.normalize(field(1.0) * 0.3 + torch.tensor((0.0, 0.0, 1.0)), dim=-1)
        velocity = 0.2 * field(2.0)
        body = BodyState(previous + DT * velocity - 0.003 * normal, normal, velocity, x + 0.002 * field(1.5))
        at = Moment(x + 0.003 * field(0.5), Step.implicit_euler(DT, previous, before), body)
        energies.append(_energy(name, cloth, at))
    coarse, middle, fine = energies
    assert abs(fine - middle) <= 0.6 * abs(middle - coarse) + 1e-6 * abs(fine), f"energies {energies} J do not settle"
    assert abs(fine - middle) <= 0.1 * abs(fine), f"energies {energies} J are far from settled"


def _varied(parameter: Parameter) -> tuple[np.ndarray, np.ndarray]:
    """A value, the default where its bounds leave room, and by how much to vary it, up and down: a fifth of the
    default, or where that is zero a tenth of what lies between the bounds, at most one of the unit."""
    default = np.asarray(parameter.default, dtype=float)
    room = parameter.upper - parameter.lower
    change = 0.2 * np.abs(default) if default.any() else np.full_like(default, min(1.0, 0.1 * room))
    change = np.minimum(change, 0.5 * room)
    return np.asarray(np.clip(default, parameter.lower + change, parameter.upper - change)), change


def parameters_matter(name: str) -> None:
    """Every parameter changes the energy; those called linear do so linearly."""
    cloth = irregular_cloth()
    at = moment(cloth)
    for key, parameter in find_effect(name).parameters.items():
        value, change = _varied(parameter)
        values = [np.clip(value + k * change, parameter.lower, parameter.upper) for k in (-1, 0, 1)]
        low, middle, high = (_energy(name, cloth, at, **{key: each}) for each in values)
        assert max(low, middle, high) - min(low, middle, high) > 1e-9 * abs(middle), f"{key} must change the energy"
        if parameter.linear:
            assert abs(low + high - 2 * middle) <= 1e-9 * abs(middle), f"{key} is called linear but is not"
    linear_together(name)


def linear_together(name: str) -> None:
    """What parameters called linear do adds up: none multiplies another."""
    linear = {key: parameter for key, parameter in find_effect(name).parameters.items() if parameter.linear}
    varied = {key: _varied(parameter) for key, parameter in linear.items()}
    cloth = irregular_cloth()
    at = moment(cloth)
    values = ({key: middle + sign * change for key, (middle, change) in varied.items()} for sign in (-1, 0, 1))
    low, middle, high = (_energy(name, cloth, at, **each) for each in values)
    told = f"{' and '.join(linear)} {'is' if len(linear) == 1 else 'are'} called linear, but the energy is not linear"
    advice = "" if len(linear) == 1 else " in all together: of those that multiply each other give all but one"
    assert abs(low + high - 2 * middle) <= 1e-9 * max(abs(low), abs(high)), (
        f"{told}{advice or '; give it'} linear=False"
    )


def parameter_slopes(name: str) -> None:
    """The derivative of the gradient by each parameter against central differences."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    term = potential.terms[name]
    for key, parameter in find_effect(name).parameters.items():
        middle, change = _varied(parameter)
        h = 5e-5 * float(change.max())
        potential.terms[name] = replace(term, values={**term.values, key: torch.as_tensor(middle)})
        found = potential.parameter_gradients(at.x, at.step, at.body, {f"{name}.{key}"})
        for entry in np.ndindex(middle.shape):
            forces = []
            for sign in (1, -1):
                value = middle.copy()
                value[entry] += sign * h
                moved = replace(term, values={**term.values, key: torch.as_tensor(value)})
                elements = potential.elements(moved, at.x, at.step, at.body)
                forces.append(moved.scatter(moved.effect.gradient(elements, moved.values)[1]).movedim(0, -1))
            slope = (forces[0] - forces[1]) / (2 * h)
            scale = max(float(found[f"{name}.{key}"].abs().max()), float(slope.abs().max()))
            error = float((found[f"{name}.{key}"][entry] - slope).abs().max())
            assert error <= 1e-5 * scale, f"slope by {key}{list(entry)}: off by {error:g} of {scale:g}"


def zero_is_nothing(name: str) -> None:
    """With all its coefficients zero the effect exerts exactly nothing."""
    effect, cloth = find_effect(name), irregular_cloth()
    if not effect.coefficients:
        return
    at = moment(cloth)
    zeros: dict[str, Any] = {key: np.zeros(np.shape(effect.parameters[key].default)) for key in effect.coefficients}
    energy, gradient = _potential(name, cloth, **zeros).gradient(at.x, at.step, at.body)
    assert float(energy) == 0 and float(gradient.abs().max()) == 0, f"still acts with {', '.join(zeros)} zero"


def parameters_are_guarded(name: str) -> None:
    """Defaults lie within bounds, values outside are refused, and a saved model comes back the same."""
    effect = find_effect(name)
    others = {other: {} for other in companions(effect)}
    model = Model(0.2, others | {name: {}})
    again = Model.from_json(model.to_json())
    for key, parameter in effect.parameters.items():
        assert np.array_equal(again.effects[name][key], model.effects[name][key]), f"{key} changed when saved"
        default = np.asarray(parameter.default, dtype=float)
        for bad in (parameter.lower - 1, parameter.upper + 1, np.nan):
            if np.isinf(bad):
                continue
            try:
                Model(0.2, others | {name: {key: np.full_like(default, bad)}})
            except CaphyError as error:
                assert key in str(error), f"the message must name {key}"
            else:
                raise AssertionError(f"{key} = {bad} must be refused")


def degenerate_is_finite(name: str) -> None:
    """Triangles without area, edges without length, and cloth at rest give finite energies, gradients and Hessians."""
    cloth = irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    collapsed = at.x.clone()
    collapsed[cloth.faces[::3, 1]] = collapsed[cloth.faces[::3, 0]]
    flattened = at.x * torch.tensor((1.0, 0.0, 0.0), dtype=torch.float64)
    rest = torch.as_tensor(cloth.vertices)
    told = [(x, replace(at.step, lagged=x)) for x in (collapsed, flattened, torch.zeros_like(at.x))]
    for x, lagged in (*told, (rest, Step.implicit_euler(DT, rest, rest))):
        energy, gradient = potential.gradient(x, lagged, at.body)
        (_, term, elements), *_ = potential.acting(x, lagged, at.body)
        _all_finite(energy, gradient, term.effect.hessian(elements, term.values))
        _all_finite(term.effect.projected_hessian(elements, term.values), *term.effect.gradient(elements, term.values))


def _all_finite(*parts: Tensor) -> None:
    assert all(bool(part.isfinite().all()) for part in parts), (
        "degenerate triangles, and cloth at rest, must give finite numbers"
    )


def left_out_in_statics(name: str) -> None:
    """Without a step or a body, an effect that needs one is left out instead of failing."""
    effect, cloth = find_effect(name), irregular_cloth()
    at, potential = moment(cloth), _potential(name, cloth)
    assert (name in potential.energies(at.x, None, at.body)) == (not effect.needs_step)
    assert (name in potential.energies(at.x, at.step, None)) == (not effect.needs_body)


CHECKS: tuple[Callable[[str], None], ...] = (
    documented,
    finite,
    batch_equals_loop,
    elements_are_their_own,
    single_precision,
    kernel_agrees,
    gradient_is_slope,
    hessian_is_slope,
    projection_is_semidefinite,
    same_in_every_frame,
    same_in_every_place,
    no_net_force,
    rests_at_rest,
    units_fit,
    refinement_converges,
    parameters_matter,
    parameter_slopes,
    zero_is_nothing,
    parameters_are_guarded,
    degenerate_is_finite,
    left_out_in_statics,
)
"""All properties, each a function of an effect's registered name."""
