"""Samples of joint rotations and of the root's path over the last moments, and smooth curves through them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from caphy.conditioning.quaternions import between, rotated
from caphy.conditioning.spline import spline_weights

SAMPLES: Final = (16, 64)
"""Samples that are kept at least, and at most: at 30 per second and the default stiffness the 16th before weighs
nothing."""
BEFORE: Final = 0.45
"""How far samples must reach back from the moment that is asked for [s]."""
COAST: Final = 0.08
"""Time over which a joint that is no longer seen comes to a stop [s]."""
STOOD: Final = 0.1
"""How long a body is taken to have stood before it was first seen [s]."""
NEVER: Final = -np.inf


class Track:
    """Samples of C channels at common times, each channel with its own trust in each sample.

    Channels are what :meth:`at` evaluates; subclasses say what a sample is. ``stiffness`` [s^4] and ``precision``
    [s], of a sample that is fully trusted, are those of :func:`spline_weights`.
    """

    def __init__(self, first: np.ndarray, stiffness: float, precision: float, latency: float = 0.0) -> None:
        """``latency``: how long after a moment it is asked for [s]."""
        channels, self._span = len(first), latency + BEFORE
        self._stiffness, self._precision = stiffness, precision
        self._times = np.zeros(0)
        self._samples = np.zeros((0, *first.shape))
        self._trust = np.zeros((0, channels))
        self._still = np.zeros(channels, bool)
        self.last = np.full(channels, NEVER)
        """When each channel was last seen (C,) [s]."""
        self._reference = first

    def add(self, time: float, sample: np.ndarray, trust: np.ndarray) -> None:
        """A sample of all channels; ``trust`` (C,) is 0 for those it does not show, up to 1."""
        within = len(self._times) - int(np.searchsorted(self._times, time - self._span)) + 1
        keep = slice(max(0, len(self._times) + 1 - min(max(within, SAMPLES[0]), SAMPLES[1])), None)
        self._times = np.append(self._times[keep], time)
        self._samples = np.concatenate([self._samples[keep], sample[None]])
        self._trust = np.concatenate([self._trust[keep], trust[None]])
        self._still = np.all(self._samples == sample, axis=(0, 2)) & (trust > 0)
        self._reference = np.where(((self.last == NEVER) & (trust > 0))[:, None], sample, self._reference)
        self.last = np.where(trust > 0, time, self.last)

    def forget(self, channels: np.ndarray) -> None:
        """Drop all samples so far of some channels (C,)."""
        self._trust[:, channels] = 0

    def at(self, time: float) -> np.ndarray:
        """The smooth value of every channel; one that was never seen keeps its first value."""
        value = self._reference.copy()
        if len(self._times):
            value[self._still] = self._samples[-1][self._still]
        for channels, samples, weights in self._groups(time):
            value[channels] = self._mixed(value[channels], self._samples[samples][:, channels], weights)
        return value

    def follow(self, value: np.ndarray) -> None:
        """Take ``value`` as the point about which samples are mixed from now on."""
        self._reference = value

    def _groups(self, time: float) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Channels (C,) that trust the same samples (N,), those samples, and the weights (C, N) of each channel."""
        if not len(self._times):
            return
        seen: dict[bytes, list[int]] = {}
        trusted = np.ascontiguousarray(self._trust.T > 0)
        for channel in np.flatnonzero(~self._still).tolist():  # fingers mostly rest, and need no curve
            seen.setdefault(trusted[channel].tobytes(), []).append(channel)
        for channels in seen.values():
            (samples,) = np.nonzero(trusted[channels[0]])
            if not len(samples):
                continue
            trust, alike = np.unique(self._trust[samples][:, channels].T, axis=0, return_inverse=True)
            weights = self._weights(self._times[samples], self._precision * trust, time)
            yield np.array(channels), samples, weights[alike.reshape(-1)]

    def _weights(self, times: np.ndarray, precision: np.ndarray, time: float) -> np.ndarray:
        """The samples' weights at ``time``, as if the first had been there a moment before, too: of a body that begins
        to be seen nobody knows the velocity, and standing is the calmest guess. Half a second later it is nothing."""
        times = np.concatenate([[times[0] - STOOD], times])
        precision = np.concatenate([np.full((len(precision), 1), self._precision), precision], axis=1)
        weights = spline_weights(times, precision, self._stiffness, _coasting(time, times[-1]))
        weights[:, 1] += weights[:, 0]
        return weights[:, 1:]

    def _mixed(self, reference: np.ndarray, samples: np.ndarray, weights: np.ndarray) -> np.ndarray:
        raise NotImplementedError


class RotationTrack(Track):
    """Joint rotations (C, 4) as unit quaternions, mixed in the tangent space at the last value of each."""

    def _mixed(self, reference: np.ndarray, samples: np.ndarray, weights: np.ndarray) -> np.ndarray:
        offsets = between(np.broadcast_to(reference, samples.shape), samples)
        return rotated(reference, np.einsum("cn,nci->ci", weights, offsets))


class PathTrack(Track):
    """Points (C, 3) [m]."""

    def _mixed(self, reference: np.ndarray, samples: np.ndarray, weights: np.ndarray) -> np.ndarray:
        return np.einsum("cn,nci->ci", weights, samples)


def _coasting(time: float, last: float) -> float:
    """The time at which a curve is evaluated whose last sample is past: motion dies away."""
    return time if time <= last else last + COAST * float(-np.expm1((last - time) / COAST))
