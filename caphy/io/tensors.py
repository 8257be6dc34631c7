"""torch's tensors inside of pickles, as arrays, without torch and without running anything.

A tensor in a plain pickle is the bytes of its storage, in torch's format from before 1.6, and how to look at them:
``torch._utils._rebuild_tensor_v2(storage, offset, size, stride, ...)``. Those bytes are four small pickles (a magic
number, a version, the system, the storage's kind and length), a list of names, the length once more, and the numbers.
"""

from __future__ import annotations

import io
import pickle
from typing import Any, Final

import numpy as np

MAGIC: Final = 0x1950A86A20F9469CFC6C
VERSION: Final = 1001
KINDS: Final[dict[str, np.dtype]] = {
    "DoubleStorage": np.dtype("<f8"),
    "FloatStorage": np.dtype("<f4"),
    "HalfStorage": np.dtype("<f2"),
    "LongStorage": np.dtype("<i8"),
    "IntStorage": np.dtype("<i4"),
    "ShortStorage": np.dtype("<i2"),
    "CharStorage": np.dtype("<i1"),
    "ByteStorage": np.dtype("<u1"),
    "BoolStorage": np.dtype("?"),
}
"""What torch calls storages of each kind of number."""

MOST: Final = 2**28
"""Numbers of one tensor: a stride of 0 makes many of few."""


class _StorageUnpickler(pickle.Unpickler):
    """Reads numbers, text and containers, and of names only those of storages."""

    def find_class(self, module: str, name: str) -> Any:
        if module != "torch" or name not in KINDS:
            raise pickle.UnpicklingError(f"tensors of {module}.{name} are not read")
        return KINDS[name]

    def persistent_load(self, pid: Any) -> Any:
        """("storage", kind, name, device, length, view): length is what counts; the device is no matter."""
        return pid


def storage(data: bytes) -> np.ndarray:
    """The numbers (N,) in the bytes of a storage; raises UnpicklingError for others."""
    file = io.BytesIO(data)
    magic, version, system, what, names = (_StorageUnpickler(file).load() for _ in range(5))
    if (magic, version) != (MAGIC, VERSION) or not system.get("little_endian") or len(names) != 1:
        raise pickle.UnpicklingError("these bytes are no storage of torch")
    tag, dtype, _, _, length, view = what
    if tag != "storage" or not isinstance(dtype, np.dtype) or view is not None:
        raise pickle.UnpicklingError("this storage of torch is not read")
    stated = int.from_bytes(file.read(8), "little")
    rest = file.read()
    if stated != length or len(rest) != length * dtype.itemsize:
        raise pickle.UnpicklingError(f"a storage of {length} numbers holds {len(rest)} bytes; cut short?")
    return np.frombuffer(rest, dtype)


def tensor(numbers: np.ndarray, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> np.ndarray:
    """An array of shape ``size`` of a storage's numbers (N,), its first at ``offset``, steps of ``stride`` numbers."""
    size, stride = tuple(int(n) for n in size), tuple(int(n) for n in stride)
    if not isinstance(numbers, np.ndarray) or len(size) != len(stride) or min((offset, *size, *stride), default=0) < 0:
        raise pickle.UnpicklingError("this tensor is not read")
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    if 0 in size:
        return np.zeros(size, numbers.dtype)
    if last >= len(numbers) or np.prod([float(n) for n in size]) > MOST:
        raise pickle.UnpicklingError(f"a tensor reaches to number {last} of a storage of {len(numbers)}")
    steps = tuple(step * numbers.itemsize for step in stride)
    return np.lib.stride_tricks.as_strided(numbers[offset:], size, steps).copy()
