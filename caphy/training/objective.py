"""The physics loss: the incremental potential of predicted frames, history detached."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from caphy.body.model import BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.effects.base import BodyState, Step
from caphy.effects.mass import require_mass
from caphy.effects.potential import Potential
from caphy.recorded import Recorded
from caphy.training.motions import Motions
from caphy.training.skin_seen import skin_seen
from caphy.training.streams import Windows


@dataclass(frozen=True)
class Past:
    """The last two predictions of each stream, world positions (B, V, 3) [m], detached."""

    before: Tensor
    previous: Tensor


@dataclass(frozen=True)
class Scene:
    """The scored frames of some windows with all that their potential depends on, each field (B, K, V, 3).

    x: positions [m], which carry the gradient; step and body: see :mod:`caphy.effects.base`.
    """

    x: Tensor
    step: Step
    body: BodyState


class Objective:
    """The potential Phi(x_t; x_{t-1}, x_{t-2}, body_t) of predicted frames, minimised over x_t alone.

    The history is the network's own, detached, so that the minimiser is implicit Euler's trajectory (SNUG minimises
    over the history too, whose minimiser is not a trajectory). Where a stream starts, or a pose is held, nothing has
    moved: the frame is an equilibrium, of pressure and wind too, which :func:`caphy.solve.statics.drape` leaves out.
    The frame after a start takes the start's offsets, carried along with the body, for its past.
    """

    def __init__(
        self, potential: Potential, body: BodyModel, template: Tensor, weights: Tensor, fps: float, betas=None
    ) -> None:
        """``template`` (V, 3) [m] and ``weights`` (V, 55) are the network's, in float32.

        Raises:
            CaphyError: a vertex would have no mass, or less, see :func:`require_mass`.
        """
        require_mass(potential)
        self.potential, self.body, self.betas, self.dt = potential, body, betas, 1 / fps
        self.template, self.weights = template, weights
        self.seen = skin_seen(body, betas, template)
        self._move = Recorded(self._moved)

    def __call__(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Past]:
        """Potential (B, K) [J] of the scored frames, weight relative to the skinned template's, and the streams' past
        after the windows.

        Args:
            offsets: predicted canonical offsets [m], (B, T, V, 3).
            past: what the previous call returned; half of it is not read where a window is fresh.
        """
        _, potential, past = self.judge(motions, windows, offsets, past)
        return potential, past

    def judge(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Tensor, Past]:
        """As calling it, with the positions (B, K, V, 3) [m] of the scored frames before the potential."""
        scene, past = self.scene(motions, windows, offsets, past)
        with torch.no_grad():
            ground = sum(ground_energies(self.potential, scene.body.anchor).values())
        return scene.x, self.potential.loss(scene.x, scene.step, scene.body) - ground, past

    def under(self, potential: Potential) -> Objective:
        """The same with another physics of the same cloth; raises what making one does."""
        require_mass(potential)
        other = copy.copy(self)
        other.potential = potential
        return other

    def scene(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Scene, Past]:
        """The scored frames at offsets (B, T, V, 3), and the streams' past after the windows."""
        device = self.template.device
        frames = torch.from_numpy(np.concatenate([windows.before[:, None], windows.frames], 1))
        fresh, still, scored = (torch.from_numpy(part) for part in (windows.fresh, windows.still, windows.scored))
        given = [part.to(device) for part in (motions.transforms[frames], fresh, still, scored)]
        moved = self._move(offsets, past.before, past.previous, *given)
        turned, now, previous, before, anchor, *past_after = moved
        time = motions.times(np.take_along_axis(windows.frames, windows.scored, 1), 1 / self.dt)
        step = replace(Step.implicit_euler(self.dt, previous, before), time=torch.from_numpy(time).to(now)[..., None])
        body = self.body_state(motions, windows, now, anchor)
        return Scene(_carried(offsets, now, turned, given[3]), step, body), Past(*past_after)

    def _moved(
        self, offsets: Tensor, before: Tensor, previous: Tensor, transforms: Tensor, fresh: Tensor, still: Tensor,
        scored: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        """Scored frames of offsets (B, T, V, 3) on bodies of transforms (B, 1 + T, 55, 3, 4), the frame before first.

        Returns of scored frames what turned them, (B, K, V, 3, 3), and positions (B, K, V, 3) [m]: their own, those of
        one and two steps before, and the skinned template's; then the streams' two last frames, for the next window.
        """
        blended = blend_transforms(self.weights, transforms)
        x = skin(blended[:, 1:], self.template + offsets)
        carried = skin(blended[:, 0], self.template + offsets[:, 0])
        history = torch.cat([before[:, None], torch.where(fresh[:, None, None], carried, previous)[:, None], x], 1)
        rows = torch.arange(len(offsets), device=x.device)[:, None]
        seen = blended[rows, scored + 1]
        now = history[rows, scored + 2]
        earlier = (torch.where(still[..., None, None], now, history[rows, scored + back]) for back in (1, 0))
        return seen[..., :3], now, *earlier, skin(seen, self.template), history[:, -2], history[:, -1]

    def body_state(self, motions: Motions, windows: Windows, x: Tensor, anchor: Tensor) -> BodyState:
        """What the vertices at x (B, K, V, 3) see of the body in the scored frames, moving as since the last frame."""
        frames = np.take_along_axis(windows.frames, windows.scored, 1).reshape(-1)
        last = frames - ~windows.still.reshape(-1)
        seen = self.seen(motions, frames, last, x.flatten(0, 1), self.dt)
        point, normal, velocity = (each.unflatten(0, x.shape[:2]) for each in seen)
        return BodyState(point, normal, velocity, anchor)


def ground_energies(potential: Potential, anchor: Tensor) -> dict[str, Tensor]:
    """Energies at the skinned template (..., V, 3) [m] that depend on where in the world it is, name -> (...,) [J].

    Weight, wherever it enters (gravity, a heavy hem, a tilt), counts relative to these.
    """
    return {
        name: term.effect.energy(potential.elements(term, anchor, None, None), term.values).sum(-1)
        for name, term in potential.present(None, None)
        if term.effect.group in ("mass", "external")
    }


def _carried(offsets: Tensor, x: Tensor, turned: Tensor, scored: Tensor) -> Tensor:
    """Positions x (B, K, V, 3), differentiable in the offsets (B, T, V, 3) whose ``scored`` frames lie there."""
    return _Carried.apply(offsets, x, turned, scored)  # pyright: ignore[reportReturnType]


class _Carried(torch.autograd.Function):
    @staticmethod
    def forward(ctx, offsets: Tensor, x: Tensor, turned: Tensor, scored: Tensor) -> Tensor:
        ctx.save_for_backward(turned, scored)
        ctx.shape = offsets.shape
        return x

    @staticmethod
    def backward(ctx, *gradient: Tensor) -> tuple[Tensor, None, None, None]:
        turned, scored = ctx.saved_tensors
        back = (turned * gradient[0][..., None]).sum(-2)
        rows = torch.arange(len(scored), device=scored.device)[:, None]
        return back.new_zeros(ctx.shape).index_put_((rows, scored), back), None, None, None
