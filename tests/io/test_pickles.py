"""The allow-list unpickler: plain data comes back, programs do not run."""

import os
import pickle
from collections import OrderedDict, defaultdict

import joblib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caphy.errors import CaphyError
from caphy.io.pickles import read_pickle

DATA = {
    0: {"a": np.arange(6.0).reshape(2, 3), "f": np.asfortranarray(np.arange(6).reshape(2, 3)), "n": np.float32(1.5)},
    "names": OrderedDict(x=[1, (2, "three"), None, True, b"bytes", {4}]),
    "many": defaultdict(dict, {"k": {"deep": np.array(["u"])}}),
}


def assert_same(a, b):
    if isinstance(b, dict):
        assert list(a) == list(b)
        for key in b:
            assert_same(a[key], b[key])
    elif isinstance(b, np.ndarray):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)
    else:
        assert a == b


@pytest.mark.parametrize("protocol", range(6))
def test_plain_pickles(tmp_path, protocol):
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(DATA, protocol=protocol))
    assert_same(read_pickle(tmp_path / "a.pkl"), DATA)


@pytest.mark.parametrize("compress", [0, 3, ("gzip", 3), ("xz", 3)])
def test_joblib_files_agree_with_joblib(tmp_path, compress):
    joblib.dump(DATA, tmp_path / "a.pkl", compress=compress)
    assert_same(read_pickle(tmp_path / "a.pkl"), joblib.load(tmp_path / "a.pkl"))


class Program:
    """Would make a folder when unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def nested(path):
    """An array of objects, which joblib stores as a second pickle inside the first."""
    array = np.empty(1, dtype=object)
    array[0] = Program(path)
    return array


@pytest.mark.parametrize("make", [Program, nested, lambda path: defaultdict(dict, {0: {"x": Program(path)}})])
@pytest.mark.parametrize("dump", [joblib.dump, lambda data, path: path.write_bytes(pickle.dumps(data))])
def test_programs_do_not_run(tmp_path, make, dump):
    made = tmp_path / "made"
    dump({0: make(made)}, tmp_path / "a.pkl")
    with pytest.raises(CaphyError, match=r"a\.pkl.*not read"):
        read_pickle(tmp_path / "a.pkl")
    assert not made.exists()
    pickle.loads(pickle.dumps({0: make(made)}))
    assert made.exists()  # the program is real: plain pickle runs it


@pytest.mark.parametrize(
    "stream",
    [
        b"cbuiltins\neval\n(V1+1\ntR.",
        b"cnumpy\nload\n(Vx\ntR.",
        b"cnumpy\nndarray\n((I9999999999\ntR.",
        b"cnumpy\ndtype\n(VO8\ntR.",
        b"cnumpy._core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I9999999\ntVb\ntR.",
        b"ccollections\ndefaultdict\n(tR}Vx\nI1\nsb.",
    ],
)
def test_handmade_streams_are_refused(tmp_path, stream):
    (tmp_path / "a.pkl").write_bytes(stream)
    with pytest.raises(CaphyError, match=r"a\.pkl"):
        read_pickle(tmp_path / "a.pkl")


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_damaged_files_end_in_a_clear_error(tmp_path_factory, seed):
    path = tmp_path_factory.mktemp("p") / "a.pkl"
    rng = np.random.default_rng(seed)
    joblib.dump(DATA, path)
    data = bytearray(path.read_bytes())
    for at in rng.integers(0, len(data), rng.integers(1, 5)):
        data[at] = int(rng.integers(256))
    path.write_bytes(data[: int(rng.integers(1, len(data) + 1))])
    try:
        read_pickle(path)
    except CaphyError as error:
        assert "a.pkl" in str(error)
