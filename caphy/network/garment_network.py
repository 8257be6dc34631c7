"""The garment network: pose features, a GRU, one linear layer to canonical offsets, skinning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from caphy.body.kinematics import joint_transforms
from caphy.body.skinning import blend_transforms, skin
from caphy.conventions import JOINT_PARENTS, MOTION_STATE
from caphy.network.features import driving_joints, feature_count, pose_features
from caphy.rotations import matrix_from_axis_angle

LAYERS = 4
WIDTH = 256


class GarmentNetwork(nn.Module):
    """Poses to garment vertices (CaPhy, section 3.2; SNUG, CVPR 2022, section 3).

    The last layer is linear, so canonical offsets are blend shapes whose weights are the GRU's output.

    The state of a stream is one vector of :attr:`state_size` = layers * width + 16 numbers: the GRU's hidden state,
    layer by layer, then the motion's (:data:`caphy.conventions.MOTION_STATE`: previous root translation [m],
    velocity [m/s], rotation row-major, number of frames seen). All zeros before the first frame.

    Args:
        template: canonical positions [m], (V, 3).
        weights: skinning weights, (V, 55).
        joints: rest positions of the body's joints [m], (55, 3).
        fps: frames per second the network runs at [Hz].
        driving: joints it sees; by default those that move the garment.
    """

    template: Tensor
    weights: Tensor
    joints: Tensor

    def __init__(
        self,
        template: np.ndarray,
        weights: np.ndarray,
        joints: np.ndarray,
        *,
        fps: float = 30.0,
        driving: Sequence[int] | None = None,
        layers: int = LAYERS,
        width: int = WIDTH,
    ) -> None:
        super().__init__()
        self.fps = float(fps)
        self.driving = driving_joints(weights) if driving is None else list(driving)
        for name, value in (("template", template), ("weights", weights), ("joints", joints)):
            self.register_buffer(name, torch.tensor(np.asarray(value), dtype=torch.float32))
        self.gru = nn.GRU(feature_count(self.driving), width, layers, batch_first=True)
        self.head = nn.Linear(width, self.template.numel())
        nn.init.zeros_(self.head.weight)  # the garment starts as the skinned template
        nn.init.zeros_(self.head.bias)
        wake(self.gru)

    @property
    def hidden_size(self) -> int:
        """Length of the GRU's part of the state."""
        return self.gru.num_layers * self.gru.hidden_size

    @property
    def state_size(self) -> int:
        """Length of a stream's state."""
        return self.hidden_size + MOTION_STATE

    def initial_state(self) -> Tensor:
        """The state (S,) before the first frame."""
        return self.template.new_zeros(self.state_size)

    def forward(self, poses: Tensor, transl: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Vertices (T, V, 3) [m] of T consecutive frames, and the state (S,) after them.

        Args:
            poses: axis-angle of every joint relative to its parent [rad], (T, 55, 3).
            transl: root translation [m], (T, 3), y up.
            state: :meth:`initial_state`, or what the previous call returned.
        """
        rotations = matrix_from_axis_angle(poses)
        hidden = state[: self.hidden_size].reshape(self.gru.num_layers, 1, self.gru.hidden_size)
        features, motion = pose_features(rotations, transl, state[self.hidden_size :], self.driving, self.fps)
        offsets, hidden = self.offsets(features[None], hidden)
        vertices = self.skinned(rotations, transl, self.template + offsets[0])
        return vertices, torch.cat([hidden.reshape(-1), motion])

    def offsets(self, features: Tensor, hidden: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Canonical offsets (B, T, V, 3) [m] of features (B, T, D), and the GRU's hidden state (layers, B, width)."""
        output, after = self.gru(features, hidden)
        return self.head(output).unflatten(-1, (-1, 3)), after

    def skinned(self, rotations: Tensor, transl: Tensor, points: Tensor) -> Tensor:
        """Canonical points (..., V, 3) where joint rotations (..., 55, 3, 3) and ``transl`` (..., 3) carry them."""
        transforms = joint_transforms(rotations, self.joints, JOINT_PARENTS)
        return skin(blend_transforms(self.weights, transforms), points) + transl[..., None, :]

    @torch.no_grad()
    def stream(self, poses: np.ndarray, transl: np.ndarray, chunk: int = 120) -> np.ndarray:
        """Vertices (T, V, 3) [m] of a whole motion at the network's frame rate, from the initial state."""
        state, frames = self.initial_state(), []
        for first in range(0, len(poses), chunk):
            part = (torch.tensor(a[first : first + chunk]).to(self.template) for a in (poses, transl))
            vertices, state = self(*part, state)
            frames.append(vertices.cpu().numpy())
        return np.concatenate(frames)


def wake(gru: nn.GRU) -> None:
    """Initial weights with which the pose reaches the last layer.

    torch's own shrink it about tenfold per layer, so that four layers begin by answering every pose alike. Normal
    input weights of gain two and orthogonal recurrent ones (Saxe et al., ICLR 2014) keep it at order one.
    """
    for name, weight in gru.named_parameters():
        if name.startswith("weight_ih"):
            nn.init.normal_(weight, std=2 / weight.shape[1] ** 0.5)
        elif name.startswith("weight_hh"):
            for gate in weight.data.chunk(3):
                nn.init.orthogonal_(gate)
        else:
            nn.init.zeros_(weight)
