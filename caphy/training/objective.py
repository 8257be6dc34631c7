"""The physics loss: the incremental potential of predicted frames, history detached."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from caphy.body.model import BodyModel
from caphy.body.skinning import blend_transforms, skin
from caphy.effects.base import BodyState, Step
from caphy.effects.potential import Potential
from caphy.training.motions import Motions
from caphy.training.nearest import BodySearch
from caphy.training.streams import Windows


@dataclass(frozen=True)
class Past:
    """The last two predictions of each stream, world positions (B, V, 3) [m], detached."""

    before: Tensor
    previous: Tensor


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
        self.search = BodySearch(body.rest(betas)[0], body.faces)

    def __call__(self, motions: Motions, windows: Windows, offsets: Tensor, past: Past | None) -> tuple[Tensor, Past]:
        """Potential (B, T) [J] and the streams' past after the window.

        Args:
            offsets: predicted canonical offsets [m], (B, T, V, 3).
            past: what the previous call returned; not read where the window is fresh.
        """
        x, anchor, past = self.placed(motions, windows, offsets, past)
        step = self.step(windows, x.detach(), past)
        body = at_most_at_skin(self.body_state(motions, windows, x.detach(), anchor), x.detach())
        loss = self.potential.loss(x, step, body)
        now = x.detach()
        return loss, Past(now[:, -2], now[:, -1])

    def placed(
        self, motions: Motions, windows: Windows, offsets: Tensor, past: Past | None
    ) -> tuple[Tensor, Tensor, Past]:
        """World positions and anchors (B, T, V, 3), and the past, made up where a stream starts."""
        device = self.template.device
        frames = torch.cat([torch.as_tensor(windows.before)[:, None], torch.as_tensor(windows.frames)], 1)
        blended = blend_transforms(self.weights, motions.transforms[frames].to(device))
        x = skin(blended[:, 1:], self.template + offsets)
        anchor = skin(blended[:, 1:], self.template.expand_as(offsets))
        carried = skin(blended[:, 0], self.template + offsets[:, 0].detach())
        if past is None:
            return x, anchor, Past(carried, carried)
        fresh = torch.as_tensor(windows.fresh, device=device)[:, None, None]
        return x, anchor, Past(past.before, torch.where(fresh, carried, past.previous))

    def step(self, windows: Windows, x: Tensor, past: Past) -> Step:
        """The step of implicit Euler that each frame of x (B, T, V, 3) takes; none where it stands still."""
        history = torch.cat([past.before[:, None], past.previous[:, None], x], 1)
        still = torch.as_tensor(windows.held)[:, None].repeat(1, x.shape[1])
        still[:, 0] |= torch.as_tensor(windows.fresh)
        still = still.to(x.device)[..., None, None]
        return Step.implicit_euler(
            self.dt, torch.where(still, x, history[:, 1:-1]), torch.where(still, x, history[:, :-2])
        )

    def body_state(self, motions: Motions, windows: Windows, x: Tensor, anchor: Tensor) -> BodyState:
        """What the vertices at x (B, T, V, 3) see of the body, its velocity over the last frame."""
        count, length = windows.frames.shape
        frames = torch.cat([torch.as_tensor(windows.before)[:, None], torch.as_tensor(windows.frames)], 1).numpy()
        flat = frames.reshape(-1)
        bodies = self.body.pose(motions.poses[flat], motions.transl[flat], self.betas).astype("float32")
        bodies = bodies.reshape(count, length + 1, -1, 3)
        now, earlier = bodies[:, 1:].reshape(count * length, -1, 3), bodies[:, :-1].reshape(count * length, -1, 3)
        found = self.search.nearest(x.flatten(0, 1).cpu().numpy(), now)
        velocity = (found.point - self.search.interpolated(found, earlier)) / self.dt
        point, normal, velocity = (
            torch.from_numpy(a).to(x).unflatten(0, (count, length)) for a in (found.point, found.normal, velocity)
        )
        return BodyState(point, normal, velocity, anchor)


def at_most_at_skin(body: BodyState, x: Tensor) -> BodyState:
    """The body with its surface lowered to vertices x (..., V, 3) that are inside: they are pushed as if at the skin.

    Equal to the body itself wherever the cloth is outside, so at every sensible minimum. Inside, a penalty that grows
    with the cube of the depth would let the few vertices caught where limb and trunk overlap drown everything else.
    """
    depth = ((body.point - x) * body.normal).sum(-1, keepdim=True).clamp_min(0)
    return replace(body, point=body.point - depth * body.normal)
