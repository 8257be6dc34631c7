"""The default parser: what colours a subject's skin and clothes have, learned from all scans of the subject at once.

No network and no labels are needed. Where the body roughly is says what each place probably is; which colours go with
which label is estimated from that, and both are made to agree (expectation maximisation with colour histograms, as in
GrabCut, Rother et al. 2004). Initial poses may be off by tens of degrees. It cannot tell apart garments of one colour
other than by place.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from caphy.body.bundled import default_body
from caphy.conventions import JOINT_NAMES
from caphy.scan.scan import Scan

BINS: Final = 24
"""Bins of the colour histograms along each axis of CIE Lab."""
SPREAD: Final = 0.8
"""Width of the Gaussian that evens histograms [bins]."""
ITERATIONS: Final = 8
SAMPLES: Final = 20_000
"""Vertices of each scan that the histograms are made of."""

PRIOR_POWER: Final = 0.35
"""The prior of place counts by this power: initial poses put many places beside the right joint."""

_PRIOR: Final[dict[tuple[str, ...], tuple[float, float, float]]] = {
    ("head", "jaw", "eye"): (0.97, 0.02, 0.0003),
    ("neck",): (0.60, 0.39, 0.001),
    ("wrist", "index", "middle", "pinky", "ring", "thumb"): (0.95, 0.04, 0.01),
    ("ankle", "foot"): (0.90, 0.0003, 0.09),
    ("spine2", "spine3", "collar"): (0.08, 0.90, 0.005),
    ("spine1",): (0.04, 0.80, 0.16),
    ("pelvis",): (0.04, 0.36, 0.60),
    ("hip",): (0.10, 0.10, 0.80),
    ("knee",): (0.40, 0.001, 0.58),
    ("shoulder",): (0.30, 0.69, 0.001),
    ("elbow",): (0.65, 0.34, 0.01),
}
"""How likely body, upper and lower garment are at a place that moves with each joint; for everyday clothes."""

_STANDING: Final = ((0.04, 0.90, 0.01, 0.09), (0.30, 0.40, 0.02, 0.58), (0.50, 0.10, 0.10, 0.80))
_STANDING_TOP: Final = ((0.56, 0.04, 0.36, 0.60), (0.80, 0.15, 0.80, 0.05), (0.87, 0.60, 0.39, 0.01))
"""The same by height, up to a share of the whole, where no pose is known: (share, body, upper, lower)."""


class ColourModel:
    """Labels of vertices from their colours and places; made for one subject by :meth:`fit`.

    Attributes:
        likelihood: how likely each colour is on what is told apart, which is all that was learnt.
    """

    def __init__(self, likelihood: np.ndarray) -> None:
        self.likelihood = likelihood

    @classmethod
    def fit(cls, scans: Sequence[Scan]) -> ColourModel:
        """The model of a subject from some of the subject's scans; five to ten are plenty.

        Raises:
            CaphyError: a scan has no colours.
        """
        random = np.random.default_rng(0)
        bins, priors = [], []
        for scan in scans:
            seen = np.unique(scan.faces)  # what is in no triangle has no colour of its own
            some = random.choice(seen, min(SAMPLES, len(seen)), replace=False)
            bins.append(_bins(scan)[some])
            priors.append(place_prior(scan)[some])
        place, prior = np.concatenate(bins), np.concatenate(priors)
        held = prior
        likelihood = _histograms(place, held)
        for _ in range(ITERATIONS):
            held = _posterior(prior, likelihood[place])
            likelihood = _histograms(place, held)
        return cls(likelihood)

    def votes(self, scan: Scan) -> np.ndarray:
        """How likely each label is at each vertex (V, 3); rows sum to one."""
        return _posterior(place_prior(scan), self.likelihood[_bins(scan)])


def place_prior(scan: Scan) -> np.ndarray:
    """How likely each label is at each vertex (V, 3) from where it lies on the initial pose, or from its height."""
    if scan.pose is None or scan.pelvis is None:
        return _height_prior(scan)
    from scipy.spatial import KDTree

    body = default_body("medium")
    posed = body.pose(scan.pose[None], (scan.pelvis - body.joints[0])[None])[0]
    nearest = KDTree(posed).query(scan.vertices)[1]
    return (body.weights @ _joint_prior())[nearest]


def _joint_prior() -> np.ndarray:
    """Prior (55, 3) of places that move with each joint."""
    table = np.zeros((len(JOINT_NAMES), 3))
    for words, prior in _PRIOR.items():
        table[[j for j, name in enumerate(JOINT_NAMES) if any(word in name for word in words)]] = prior
    return table


def _height_prior(scan: Scan) -> np.ndarray:
    """Prior (V, 3) of a standing person; even for one who does not stand."""
    height = scan.vertices[:, 1]
    low, high = np.quantile(height, [0.0005, 0.9995])
    if high - low < 1.4:
        return np.full((len(height), 3), 1 / 3)
    share = (height - low) / (high - low)
    steps = np.array([*_STANDING, *_STANDING_TOP, (np.inf, 0.97, 0.02, 0.01)])
    return steps[np.searchsorted(steps[:-1, 0], share), 1:]


def _bins(scan: Scan) -> np.ndarray:
    """Number of the colour bin of each vertex (V,)."""
    import cv2

    if scan.colours is None:
        raise scan.error(
            "has no colours, which the colour model needs; export vertex colours or a texture, or segment with "
            "--parser labels or an ONNX human parser"
        )
    if not np.ptp(scan.colours, axis=0).any():
        raise scan.error("all vertices have one colour; is the texture missing? Export it beside the mesh")
    lab = cv2.cvtColor(scan.colours[:, None], cv2.COLOR_RGB2LAB)[:, 0].astype(int) * BINS // 256
    return (lab[:, 0] * BINS + lab[:, 1]) * BINS + lab[:, 2]


def _histograms(place: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Probability of each colour under each label (BINS^3, 3) from bins (N,) and shares of labels (N, 3)."""
    from scipy.ndimage import gaussian_filter

    likelihood = np.empty((BINS**3, held.shape[1]))
    for label in range(held.shape[1]):
        counts = np.bincount(place, held[:, label], BINS**3).reshape((BINS,) * 3)
        likelihood[:, label] = gaussian_filter(counts, SPREAD, mode="constant").ravel() + 1e-3
    return likelihood / likelihood.sum(axis=0)


def _posterior(prior: np.ndarray, likelihood: np.ndarray) -> np.ndarray:
    both = prior**PRIOR_POWER * likelihood
    return both / both.sum(axis=1, keepdims=True)
