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
from caphy.effects.potential import Potential
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
    over the history too, whose minimiser is not a trajectory). Where a stream starts, or a pose is held, inertia and
    everything else that needs motion rest: the frame is a static equilibrium. The frame after a start takes the
    start's offsets, carried along with the body, for its past.
    """

    def __init__(
        self, potential: Potential, body: BodyModel, template: Tensor, weights: Tensor, fps: float, betas=None
    ) -> None:
        """``template`` (V, 3) [m] and ``weights`` (V, 55) are the network's, in float32."""
        self.potential, self.body, self.betas, self.dt = potential, body, betas, 1 / fps
        self.template, self.weights = template, weights
        self.seen = skin_seen(body, betas, template)

    def __call__(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Past]:
        """Potential (B, K) [J] of the scored frames, and the streams' past after the windows.

        Args:
            offsets: predicted canonical offsets [m], (B, T, V, 3).
            past: what the previous call returned; half of it is not read where a window is fresh.
        """
        _, potential, past = self.judge(motions, windows, offsets, past)
        return potential, past

    def judge(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Tensor, Tensor, Past]:
        """As calling it, with the positions (B, K, V, 3) [m] of the scored frames before the potential."""
        scene, past = self.scene(motions, windows, offsets, past)
        return scene.x, self.potential.loss(scene.x, scene.step, scene.body), past

    def under(self, potential: Potential) -> Objective:
        """The same with another physics of the same cloth."""
        other = copy.copy(self)
        other.potential = potential
        return other

    def scene(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past) -> tuple[Scene, Past]:
        """The scored frames at offsets (B, T, V, 3), and the streams' past after the windows."""
        device = self.template.device
        frames = torch.from_numpy(np.concatenate([windows.before[:, None], windows.frames], 1))
        blended = blend_transforms(self.weights, motions.transforms[frames].to(device))
        x = skin(blended[:, 1:], self.template + offsets)
        carried = skin(blended[:, 0], self.template + offsets[:, 0].detach())
        fresh = torch.from_numpy(windows.fresh).to(device)[:, None, None]
        past = Past(past.before, torch.where(fresh, carried, past.previous))
        history = torch.cat([past.before[:, None], past.previous[:, None], x.detach()], 1)

        rows = torch.arange(len(frames), device=device)[:, None]
        scored = torch.from_numpy(windows.scored).to(device)
        anchor = skin(blended[rows, scored + 1], self.template)
        still = torch.from_numpy(windows.held[:, None] | (windows.fresh[:, None] & (windows.scored == 0)))
        still = still.to(device)[..., None, None]
        now = history[rows, scored + 2]
        previous, before = (torch.where(still, now, history[rows, scored + back]) for back in (1, 0))
        time = motions.times(np.take_along_axis(windows.frames, windows.scored, 1), 1 / self.dt)
        step = replace(Step.implicit_euler(self.dt, previous, before), time=torch.from_numpy(time).to(now)[..., None])
        body = self.body_state(motions, windows, now, anchor)
        return Scene(x[rows, scored], step, body), Past(history[:, -2], history[:, -1])

    def body_state(self, motions: Motions, windows: Windows, x: Tensor, anchor: Tensor) -> BodyState:
        """What the vertices at x (B, K, V, 3) see of the body in the scored frames, moving as since the last frame."""
        frames = np.take_along_axis(windows.frames, windows.scored, 1).reshape(-1)
        last = frames - np.repeat(~windows.held, windows.scored.shape[1])
        seen = self.seen(motions, frames, last, x.flatten(0, 1), self.dt)
        point, normal, velocity = (each.unflatten(0, x.shape[:2]) for each in seen)
        return BodyState(point, normal, velocity, anchor)
