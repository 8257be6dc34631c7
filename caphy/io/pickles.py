"""Reading pickled results of pose estimators without running what they ask for.

A pickle is a program. This reader knows the few names that arrays and plain containers need and refuses every other,
so nothing in a file can call code. joblib's way of storing arrays beside the pickle stream is understood without
joblib, torch's tensors become arrays without torch. For offline conversion only: the service accepts no pickles.
"""

from __future__ import annotations

import bz2
import io
import lzma
import pickle
import zlib
from collections import OrderedDict, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Final

import numpy as np

from caphy.errors import CaphyError
from caphy.io import tensors
from caphy.io.unpacked import MAX_BYTES

_OPENERS: Final[dict[bytes, Callable[[], Any]]] = {
    b"\x78": zlib.decompressobj,
    b"\x1f\x8b": lambda: zlib.decompressobj(wbits=31),
    b"BZ": bz2.BZ2Decompressor,
    b"\xfd7": lzma.LZMADecompressor,
    b"]\x00": lzma.LZMADecompressor,
}
"""Decompressors by the first bytes of zlib, gzip, bzip2, xz and lzma content."""

_KINDS: Final = "biufcSU"


class _JoblibArray:
    """Stand-in for joblib's NumpyArrayWrapper: its state describes raw bytes that follow in the file."""

    subclass: type
    shape: tuple[int, ...]
    order: str
    dtype: np.dtype
    numpy_array_alignment_bytes: int | None = None

    def read(self, file: io.BytesIO) -> np.ndarray:
        if not isinstance(self.dtype, np.dtype) or self.dtype.kind not in _KINDS:
            raise pickle.UnpicklingError(f"arrays of {self.dtype} are not read")
        if self.numpy_array_alignment_bytes is not None:
            file.read(file.read(1)[0])
        count = int(np.prod([int(size) for size in self.shape], dtype=object))
        data = file.read(count * self.dtype.itemsize) if count >= 0 else b""
        values = np.frombuffer(data, dtype=self.dtype, count=count)
        shaped = values.reshape(self.shape[::-1]).T if self.order == "F" else values.reshape(self.shape)
        return shaped.copy()


class _ArrayType:
    """What ``numpy.ndarray`` means in a pickle here: a name to compare with, which makes nothing."""


def _latin1(text: str, encoding: str) -> bytes:
    """Bytes as old pickle protocols write them."""
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"text in {encoding!r} is not read")
    return text.encode("latin1")


def _empty_array(subtype: type, shape: tuple[int, ...], code: bytes | str) -> np.ndarray:
    if subtype is not _ArrayType or shape != (0,) or code not in (b"b", "b"):
        raise pickle.UnpicklingError("only plain arrays are read")
    return np.ndarray((0,), dtype="b")


def _dtype(code: str, align: bool = False, copy: bool = True) -> np.dtype:
    if not isinstance(code, str) or np.dtype(code).kind not in _KINDS:
        raise pickle.UnpicklingError(f"arrays of {code!r} are not read")
    return np.dtype(code, align=bool(align), copy=bool(copy))


def _scalar(dtype: np.dtype, data: bytes) -> Any:
    if not isinstance(dtype, np.dtype) or dtype.kind not in _KINDS:
        raise pickle.UnpicklingError(f"numbers of {dtype} are not read")
    return np.frombuffer(data, dtype=dtype, count=1)[0]


def _from_buffer(data: bytes, dtype: np.dtype, shape: tuple[int, ...], order: str) -> np.ndarray:
    if not isinstance(dtype, np.dtype) or dtype.kind not in _KINDS:
        raise pickle.UnpicklingError(f"arrays of {dtype} are not read")
    return np.frombuffer(data, dtype=dtype).reshape(shape, order="F" if order == "F" else "C").copy()


_ALLOWED: Final[dict[tuple[str, str], Any]] = {
    ("collections", "OrderedDict"): OrderedDict,
    ("collections", "defaultdict"): defaultdict,
    **{("builtins", kind.__name__): kind for kind in (dict, list, tuple, set)},
    **{("__builtin__", kind.__name__): kind for kind in (dict, list, tuple, set)},
    ("numpy", "ndarray"): _ArrayType,
    ("_codecs", "encode"): _latin1,
    ("numpy", "dtype"): _dtype,
    **{
        (f"numpy.{core}.multiarray", name): value
        for core in ("core", "_core")
        for name, value in (("_reconstruct", _empty_array), ("scalar", _scalar))
    },
    **{(f"numpy.{core}.numeric", "_frombuffer"): _from_buffer for core in ("core", "_core")},
    ("joblib.numpy_pickle", "NumpyArrayWrapper"): _JoblibArray,
    ("torch.storage", "_load_from_bytes"): tensors.storage,
    ("torch._utils", "_rebuild_tensor_v2"): tensors.tensor,
}


_PythonUnpickler: Any = vars(pickle)["_Unpickler"]


class _Unpickler(_PythonUnpickler):
    """Python's own unpickler with an allow-list; the one written in Python, because arrays follow in its stream."""

    dispatch: ClassVar = dict(_PythonUnpickler.dispatch)

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self._file = file

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is not on the list of harmless names")
        return _ALLOWED[module, name]

    def load_build(self) -> None:
        target, state = self.stack[-2], self.stack[-1]
        if not isinstance(target, _JoblibArray | np.ndarray | np.dtype):
            raise pickle.UnpicklingError(f"state for a {type(target).__name__} is not read")
        if isinstance(target, np.ndarray) and (len(state) != 5 or state[2].kind not in _KINDS):
            raise pickle.UnpicklingError("arrays of Python objects are not read")
        if isinstance(target, _JoblibArray):
            self.stack.pop()
            vars(target).update({str(key): value for key, value in state.items()})
            self.stack[-1] = target.read(self._file)
        else:
            super().load_build()

    dispatch[pickle.BUILD[0]] = load_build


class _ObjectKind:
    """What the dtype "object" means in a pickle here: what an array of such holds is a list."""


class _BoxUnpickler(_Unpickler):
    """Of what ``numpy.save`` writes for objects that are no array: they lie in an array of Python objects."""

    dispatch: ClassVar = dict(_Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> Any:
        return _dtype_of_box if (module, name) == ("numpy", "dtype") else super().find_class(module, name)

    def load_build(self) -> None:
        target, state = self.stack[-2], self.stack[-1]
        if isinstance(target, _ObjectKind):
            self.stack.pop()
        elif isinstance(target, np.ndarray) and isinstance(state[2], _ObjectKind):
            self.stack.pop()
            self.stack[-1] = list(state[4])
        else:
            super().load_build()

    dispatch[pickle.BUILD[0]] = load_build


def _dtype_of_box(code: str, align: bool = False, copy: bool = True) -> np.dtype | _ObjectKind:
    return _ObjectKind() if code in ("O", "O8") else _dtype(code, align, copy)


def read_boxed(path: Path) -> Any:
    """The one object in an ``.npy`` file of ``numpy.save(path, object)``, as :func:`read_pickle` reads it."""

    def read(data: bytes) -> Any:
        file = io.BytesIO(data)
        version = np.lib.format.read_magic(file)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(file)
        if not dtype.hasobject or shape != ():
            raise pickle.UnpicklingError(f"it holds an array of {dtype} of shape {shape}, not one object")
        (boxed,) = _BoxUnpickler(file).load()
        return boxed

    return _read(path, read)


def read_pickle(path: Path) -> Any:
    """The containers, numbers and arrays in a pickle or joblib file.

    Raises :class:`CaphyError` for a damaged file or one that asks for anything but plain containers and arrays.
    """
    return _read(path, lambda data: _Unpickler(io.BytesIO(_decompressed(data))).load())


def _read(path: Path, reader: Callable[[bytes], Any]) -> Any:
    path = Path(path)
    try:
        if path.stat().st_size > MAX_BYTES:
            raise CaphyError(f"{path}: is larger than {MAX_BYTES / 2**30:.0f} GiB; split it first")
        return reader(path.read_bytes())
    except pickle.UnpicklingError as error:
        raise CaphyError(
            f"{path}: this pickle is not read: {error}. Only plain containers, numeric arrays and tensors are; "
            "convert other objects to arrays where the file was made"
        ) from error
    except CaphyError:
        raise
    except Exception as error:  # a damaged stream can fail anywhere in the machine that runs it
        raise CaphyError(f"{path}: cannot be read as a pickle ({type(error).__name__}: {error}); damaged?") from error


def _decompressed(data: bytes) -> bytes:
    """The content of ``data``, which joblib may have compressed, or ``data`` itself."""
    opener = next((opener for magic, opener in _OPENERS.items() if data.startswith(magic)), None)
    if opener is None:
        return data
    stream = opener()
    content = stream.decompress(data, MAX_BYTES)
    if not stream.eof:
        raise pickle.UnpicklingError("its compressed content is cut short or too large")
    return content
