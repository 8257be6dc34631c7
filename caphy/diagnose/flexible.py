"""What flexible forces, which belong to no effect, take away of a misfit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import comb

import numpy as np

from caphy.diagnose.probes import ORDER, STEADY, TO_AND_FRO, probe_places
from caphy.refit.evidence import Evidence, Weighing, ridged
from caphy.refit.responses import Response
from caphy.refit.study import Study

RIDGE = 1e-2
"""Shrinks the many pressures of a probe."""
BEATS = tuple(0.2 * k for k in range(2, 21))
"""Swings per second at which what pulls to and fro at a place of the cloth is looked for."""
_SAMPLES = 33  # times of a window at which a swing is followed


@dataclass(frozen=True, eq=False)
class Told:
    """One probe, fitted.

    Attributes:
        misfit: chi2 of each window (W,), fitted to all the others.
        change: its pressures (K,) [Pa], fitted to all; of what swings those of the cosine, then of the sine.
        beat: swings per second, where it swings.
    """

    misfit: np.ndarray
    change: np.ndarray
    beat: float | None = None


@dataclass(frozen=True, eq=False)
class Flexible:
    """What windows say of all fields of all probes.

    Attributes:
        known: the quadratic forms.
        spans: when each window begins and ends (W, 2) [s]; polynomials in time count from the middle.
    """

    known: Evidence
    spans: np.ndarray

    @classmethod
    def of(cls, study: Study, responses: Sequence[Response], weighing: Weighing) -> Flexible:
        """Of responses whose columns are the fields."""
        rates = [each.scene.measurement.fps for each in study.watched]
        spans = [np.array([r.start, r.start + len(r.seen)]) / rates[r.scene] for r in responses]
        centred = [_centred(response, span.mean()) for response, span in zip(responses, spans, strict=True)]
        return cls(weighing.of(centred), np.stack(spans))

    @property
    def null(self) -> np.ndarray:
        """chi2 of each window (W,) without any."""
        return self.known.misfit(np.zeros(self.known.b.shape[1]))

    @cached_property
    def told(self) -> dict[str, Told]:
        """The probes that act here; of what swings the best beat."""
        found, told = {}, partial(ridged, ridge=RIDGE)
        for name, place in probe_places().items():
            if self.known.b[:, place].any():
                forms = self._swinging() if name == TO_AND_FRO else [(None, self.known.picked(place))]
                tried = [Told(form.misfit(form.left_out(told)), told(*form.normal), beat) for beat, form in forms]
                found[name] = min(tried, key=lambda each: each.misfit.sum())
        return found

    @property
    def gains(self) -> dict[str, float]:
        """Share of the misfit that each probe takes away in windows left out of its fit."""
        return {name: 1 - float(each.misfit.sum() / self.null.sum()) for name, each in self.told.items()}

    def _swinging(self) -> Iterator[tuple[float, Evidence]]:
        """The forms of what swings at each beat, made of what polynomials in time do within each window."""
        places = probe_places()
        both, windows = self.known.picked([*places[STEADY], *places[TO_AND_FRO]]), len(self.spans)
        a = both.a.reshape(windows, ORDER + 1, -1, ORDER + 1, len(places[STEADY]))
        b = both.b.reshape(windows, ORDER + 1, -1)
        for beat in BEATS:
            mix = np.stack([_followed(beat, *span) for span in self.spans])  # (W, powers, 2)
            size = 2 * b.shape[-1]
            mixed = np.einsum("wdp,wdkel,weq->wpkql", mix, a, mix, optimize=True).reshape(windows, size, size)
            yield beat, replace(both, a=mixed, b=np.einsum("wdp,wdk->wpk", mix, b).reshape(windows, size))


def _centred(response: Response, middle: float) -> Response:
    """Powers of the time that count from the middle of the window [s].

    Of films of minutes the quadratic form could not tell them from the start's: it squares their cubes.
    """
    places = probe_places()
    index = np.array([*places[STEADY], *places[TO_AND_FRO]]).reshape(ORDER + 1, -1)
    columns = response.columns.copy()
    for power in range(1, ORDER + 1):
        parts = (comb(power, k) * (-middle) ** (power - k) * response.columns[..., index[k]] for k in range(power + 1))
        columns[..., index[power]] = sum(parts)
    return replace(response, columns=columns)


def _followed(beat: float, first: float, last: float) -> np.ndarray:
    """Coefficients (powers, 2) of the polynomials in time, from the middle of a span [s], nearest to a cosine and a
    sine there."""
    time = np.linspace(first, last, _SAMPLES)
    waves = np.stack([np.cos(2 * np.pi * beat * time), np.sin(2 * np.pi * beat * time)], 1)
    powers = np.vander(time - (first + last) / 2, ORDER + 1, increasing=True)
    return np.linalg.lstsq(powers, waves, rcond=None)[0]
