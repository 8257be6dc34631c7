"""Numbers told by all windows but each."""

from __future__ import annotations

import numpy as np

from caphy.refit.evidence import Evidence, ridged


def test_each_window_is_told_of_by_the_others_alone():
    random = np.random.default_rng(4)
    columns, residual = random.normal(size=(6, 9, 3)), random.normal(size=(6, 9))
    weight = random.uniform(0.2, 2.0, 6)
    a, b = np.einsum("wnk,wnl->wkl", columns, columns), np.einsum("wnk,wn->wk", columns, residual)
    known = Evidence(a, b, (residual**2).sum(-1), weight, np.full(6, 9))
    told = known.left_out(lambda normal, right: ridged(normal, right, 0.0))
    for window in range(6):
        others = np.arange(6) != window
        root = np.sqrt(weight[others])[:, None]
        rows, wanted = (root[..., None] * columns[others]).reshape(-1, 3), (root * residual[others]).ravel()
        np.testing.assert_allclose(told[window], np.linalg.lstsq(rows, wanted, rcond=None)[0], rtol=1e-9)


def test_without_columns_nothing_is_told():
    known = Evidence(np.zeros((2, 0, 0)), np.zeros((2, 0)), np.array([2.0, 3.0]), np.ones(2), np.full(2, 9))
    told = known.left_out(lambda normal, right: ridged(normal, right, 0.0))
    np.testing.assert_array_equal(known.misfit(told), [2.0, 3.0])
