"""The bounded least squares of one outer round: data, and a prior that the table keeps the start's pattern."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import lsq_linear

from caphy.fabric.coefficients import Coefficients
from caphy.fabric.evidence import CONTACT, Said

PATTERN = 0.3
"""Standard deviation of a number from the start's table as a whole, of its own size. The table's scale is free."""
LOOSE = 30.0
"""That of a table's scale, of the start's."""
NUISANCE = 3.0
"""That of the contact's numbers, in their sizes."""
LIKELY = 1.0
"""Least share of the mean squared residual that counts as noise, where scans agree to the last."""
COUPLED = 0.7
"""Most of the coupling of both stretches, of what the membrane can bear, unless the start's table has more."""
FASTEST = 2.5
"""A number grows or shrinks at most this many times in a round, for the response is not linear."""


@dataclass(frozen=True, eq=False)
class Pooled:
    """All scans together, in units of their own noise.

    Attributes:
        a, b: normal equations (N, N), (N,), each scan weighted alike.
        noise: variance that one residual adds to them, its neighbours' likeness included.
    """

    a: np.ndarray
    b: np.ndarray
    noise: float

    @classmethod
    def of(cls, said: Sequence[Said], weight: np.ndarray | None = None) -> Pooled:
        """The sum of scans, with weights (S,) where drawn again.

        The noise is told by how much scans disagree (a sandwich estimate): neighbouring points share the errors of the
        mesh, of the body and of the folds, so that a thousand of them say less than a thousand times as much as one.
        """
        w = np.ones(len(said)) if weight is None else weight
        a = np.einsum("s,skl->kl", w, np.array([one.a for one in said]))
        b = w @ np.array([one.b for one in said])
        size = np.sqrt(np.diag(a))
        told = size > 0
        scale = np.where(told, size, 1.0)
        ridge = 1e-9 * np.eye(len(b))
        step = np.linalg.solve(a / scale / scale[:, None] + ridge, b / scale) / scale
        left = np.array([one.b - one.a @ step for one in said]) / scale
        white = sum(one.c for one in said) / max(sum(one.count for one in said), 1)
        noise = max(float(np.median((w @ left**2)[told])) if told.any() else 0.0, LIKELY * white, 1e-30)
        return cls(a, b, noise)


def prior_precision(numbers: Coefficients, values: np.ndarray) -> np.ndarray:
    """Inverse covariance (K, K) of the numbers round the start's, where a whole table may be scaled at little price."""
    total = np.zeros((len(values), len(values)))
    for group in range(len(numbers.names)):
        mine = np.flatnonzero(numbers.group == group)
        start = numbers.values[mine]
        grown = max(float(values[mine].sum() / start.sum()), 1e-3)
        covariance = np.diag((PATTERN * grown * start) ** 2) + LOOSE**2 * np.outer(start, start)
        total[np.ix_(mine, mine)] = np.linalg.inv(covariance)
    return total


def solve(pooled: Pooled, numbers: Coefficients, values: np.ndarray) -> np.ndarray:
    """The numbers (K,) after one round that started from ``values`` (K,), within bounds and not changed too much."""
    count = len(values)
    information = pooled.a / pooled.noise
    right = pooled.b / pooled.noise
    precision = prior_precision(numbers, values)
    information[:count, :count] += precision
    right[:count] += precision @ (numbers.values - values)
    information[count:, count:] += np.eye(len(CONTACT)) / NUISANCE**2
    low, high = bounds(numbers, values)
    size = np.concatenate([np.maximum(values, 1e-12), np.ones(len(CONTACT))])
    scaled = information * size * size[:, None]
    lower = np.linalg.cholesky(scaled + 1e-12 * np.trace(scaled) / len(scaled) * np.eye(len(scaled)))
    wide = np.full(len(CONTACT), 10 * NUISANCE)
    limits = (
        np.concatenate([(low - values) / size[:count], -wide]),
        np.concatenate([(high - values) / size[:count], wide]),
    )
    found = lsq_linear(lower.T, np.linalg.solve(lower, right * size), limits, method="bvls")
    return stable(numbers, values + found.x[:count] * size[:count])


def stable(numbers: Coefficients, values: np.ndarray) -> np.ndarray:
    """Values (K,) with the stretching's coupling C_uuvv lowered where with it a strain in the plane would cost nothing.

    A row whose C_uuvv exceeds the root of C_uuuu C_vvvv is no membrane: some stretch of it yields energy, and a worn
    garment of it goes anywhere. Rows may come as near to that as the start's table does.
    """
    if "strain_measured" not in numbers.names:
        return values
    found, mine = values.copy(), numbers.group == numbers.names.index("strain_measured")
    table, start = (table[mine].reshape(-1, 4) for table in (values, numbers.values))
    most = np.maximum(COUPLED, start[:, 1] / np.sqrt(start[:, 0] * start[:, 2]))
    table = table.copy()
    table[:, 1] = np.minimum(table[:, 1], most * np.sqrt(table[:, 0] * table[:, 2]))
    found[mine] = table.ravel()
    return found


def bounds(numbers: Coefficients, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest values (K,) of a round: the parameters' own bounds, and a factor of those it starts from."""
    own = np.array([(column.declared.lower, column.declared.upper) for column in numbers.columns])
    low = np.maximum(values / FASTEST, own[:, 0])
    high = np.minimum(FASTEST * values, own[:, 1])
    return np.minimum(low, values), np.maximum(high, values)
