"""The sparse Hessian and its factor against dense linear algebra and automatic differentiation."""

import ctypes

import numpy as np
import pytest
import torch
from scipy.sparse import coo_array

from caphy.effects.base import Step
from caphy.effects.model import Model
from caphy.effects.potential import Potential
from caphy.solve.assembly import Hessian
from caphy.solve.factorize import Symbolic
from caphy.solve.ordering import dissect


def mesh_matrix(sheet, rng, columns=23, rows=11):
    """Pattern, positions, and a random positive definite matrix on it (dense) with its stored blocks."""
    cloth = sheet(1.0, 0.5, columns, rows)
    count = len(cloth.vertices)
    pairs = np.concatenate([cloth.hinges[:, [i, j]] for i in range(4) for j in range(4)])
    pattern = coo_array((np.ones(len(pairs)), pairs.T), (count, count)).tocsr()
    separators = dissect(pattern, cloth.vertices)
    rank = np.argsort(np.concatenate([separator.vertices for separator in separators]))
    dense = np.kron(pattern.toarray() > 0, np.ones((3, 3))) * rng.uniform(-1, 1, (3 * count, 3 * count))
    dense = dense + dense.T
    dense += np.diag(np.abs(dense).sum(1) + 0.1)
    order = np.argsort(rank)
    row, column = np.nonzero(np.tril(pattern.toarray()[np.ix_(order, order)]))
    blocks = dense.reshape(count, 3, count, 3).swapaxes(1, 2)[order[row], order[column]]
    return Symbolic(separators, pattern, row, column), dense, blocks, separators


def test_solves_like_dense_algebra(sheet):
    rng = np.random.default_rng(0)
    symbolic, dense, values, _ = mesh_matrix(sheet, rng)
    right = rng.normal(size=(len(dense) // 3, 3, 4))
    found = symbolic.factorize(values).solve(right)
    expected = np.linalg.solve(dense, right.reshape(len(dense), 4)).reshape(right.shape)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_what_routines_are_told_stays_in_memory_while_they_work(sheet, monkeypatch):
    """A routine that allocates, as BLAS does when it is first called, must not overwrite its own arguments."""
    libc = ctypes.CDLL(None)
    libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
    seen = []

    @ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 11)
    def trsm(side, lower, turned, unit, m, n, one, a, lda, b, ldb):
        for size in range(16, 513, 8):
            for _ in range(20):
                ctypes.memset(libc.malloc(size), 0xFF, size)
        letters = b"".join(ctypes.string_at(each, 1) for each in (side, lower, turned, unit))
        seen.append((letters, ctypes.c_double.from_address(one).value))

    symbolic, _, values, _ = mesh_matrix(sheet, np.random.default_rng(6))
    address = {np.float64: np.uint64(ctypes.cast(trsm, ctypes.c_void_p).value)}
    factor = symbolic.factorize(values)
    monkeypatch.setattr("caphy.solve.factorize.TRSM", address)
    factor.solve(np.zeros((len(symbolic.order), 3, 2)))
    symbolic.factorize(values)
    assert {one for _, one in seen} == {1.0}
    assert {letters for letters, _ in seen} == {b"RLTN", b"LLNN", b"LLTN"}


def test_a_factor_survives_later_factorisations(sheet):
    rng = np.random.default_rng(1)
    symbolic, dense, values, _ = mesh_matrix(sheet, rng)
    right = rng.normal(size=(len(dense) // 3, 3))
    factor = symbolic.factorize(values)
    before = factor.solve(right)
    symbolic.factorize(2 * values)
    np.testing.assert_array_equal(factor.solve(right), before)


def test_an_indefinite_matrix_has_no_factor(sheet):
    symbolic, dense, values, _ = mesh_matrix(sheet, np.random.default_rng(2))
    shifted = dense - (np.linalg.eigvalsh(dense)[0] + 1e-6) * np.eye(len(dense))
    assert np.linalg.eigvalsh(shifted)[0] < 0
    assert symbolic.factorize(-values) is None


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_matrix_with_an_entry_that_is_no_number_has_no_factor(sheet, dtype):
    symbolic, _, values, _ = mesh_matrix(sheet, np.random.default_rng(2))
    for place in (0, len(values) // 2, -1):
        wrong = values.copy()
        wrong[place, 0, 0] = np.nan
        assert symbolic.factorize(wrong, dtype) is None
    factor = symbolic.factorize(values, dtype)
    assert factor.solve(np.zeros((len(symbolic.order), 3, 0))).shape == (len(symbolic.order), 3, 0)


def test_dissection_eliminates_every_vertex_once(sheet):
    _, dense, _, separators = mesh_matrix(sheet, np.random.default_rng(3))
    order = np.concatenate([separator.vertices for separator in separators])
    np.testing.assert_array_equal(np.sort(order), np.arange(len(dense) // 3))


@pytest.mark.parametrize("projection", [0.0, 1.0])
def test_assembly_equals_automatic_differentiation(sheet, projection):
    """A stretched sheet is stable, so the exact Hessian is what autograd says; projected it only gains."""
    cloth = sheet(0.4, 0.3, 4, 3)
    potential = Potential(Model(0.2, {"strain_stvk": {}, "bending": {}, "gravity": {}, "inertia": {}}), cloth)
    rng = np.random.default_rng(4)
    x = torch.from_numpy(1.1 * cloth.vertices + 0.01 * rng.normal(size=cloth.vertices.shape))
    step = Step.implicit_euler(1 / 30, x, x)

    def energy(positions):
        return sum(potential.energies(positions, step).values())

    expected = torch.autograd.functional.hessian(energy, x).reshape(3 * len(x), -1).numpy()
    hessian = Hessian(potential)
    found = hessian.matrix(hessian.values(x, step, projection=projection)).toarray()
    if projection == 0:
        np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    else:
        assert np.linalg.eigvalsh(found)[0] > 0
        assert np.abs(found - expected).max() < 0.2 * np.abs(expected).max()


def test_fixed_vertices_do_not_move(sheet):
    cloth = sheet(0.4, 0.3, 4, 3)
    potential = Potential(Model(0.2, {"strain_stvk": {}, "inertia": {}}), cloth)
    fixed = np.arange(len(cloth.vertices)) < 3
    x = torch.from_numpy(1.2 * cloth.vertices)
    hessian = Hessian(potential, fixed)
    right = np.ones_like(cloth.vertices)
    right[fixed] = 0
    solution = hessian.factorize(hessian.values(x, Step.implicit_euler(0.1, x, x))).solve(right)
    assert np.abs(solution[fixed]).max() == 0
    assert np.abs(solution[~fixed]).min() > 0
