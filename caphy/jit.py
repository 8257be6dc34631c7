"""Compiled loops, kept on disk by all of caphy's code that they follow from.

numba keeps compiled code as long as its own file is the same, whatever it takes from others: after another constant in
an effect's file, kernels that import it would go on with the old one. And its processes write beside each other: of two
that compile for two types at once, one could leave what the other's name stands for.
"""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import IndexDataCacheFile

import caphy

ROOT = Path(caphy.__file__).parent
"""The package."""


def compiled(**options: Any) -> Callable[[Callable], Callable]:
    """As ``numba.njit`` with these options, and kept on disk."""

    def compile_later(function: Callable) -> Callable:
        made: Any = numba.njit(cache=True, **options)(function)
        if made is function:  # NUMBA_DISABLE_JIT
            return made
        numbas, place = made._cache._cache_file, made._cache.cache_path
        stamp = numbas._source_stamp, followed(Path(function.__code__.co_filename))
        made._cache._cache_file = CacheFile(place, numbas._index_name.removesuffix(".nbi"), stamp)
        return made

    return compile_later


class CacheFile(IndexDataCacheFile):
    """numba's files of a function; processes write one after another, and what an index names is there before it."""

    def save(self, key: object, data: object) -> None:
        """Keep compiled code by a key."""
        with self._alone():
            known = self._load_index()
            others = {*known.values()} - {known.get(key)}
            mark = hashlib.sha256(repr(self._source_stamp).encode()).hexdigest()[:12]  # no file of older code is reused
            stem = self._index_name.removesuffix(".nbi")
            names = (f"{stem}.{mark}.{number}.nbc" for number in range(1, len(others) + 2))
            name = known.get(key) or next(name for name in names if name not in others)
            self._save_data(name, data)
            self._save_index({**known, key: name})

    @contextmanager
    def _alone(self) -> Iterator[None]:
        with open(Path(self._cache_path) / f"{self._index_name}.lock", "ab") as lock:
            with suppress(ImportError):  # elsewhere processes take their chances, as numba's do everywhere
                import fcntl

                fcntl.flock(lock, fcntl.LOCK_EX)  # let go as the file is closed
            yield


@cache
def followed(file: Path, root: Path = ROOT) -> str:
    """A digest of a file of the package in ``root`` and of all others of it that it imports, directly or not."""
    found, waiting = set(), [file.resolve()]
    while waiting:
        one = waiting.pop()
        if one not in found:
            found.add(one)
            waiting += _imported(one, root.resolve())
    told = hashlib.sha256()
    for one in sorted(found):
        told.update(one.read_bytes())
    return told.hexdigest()


@cache
def _imported(file: Path, root: Path) -> tuple[Path, ...]:
    """The files of a package that a file imports from."""
    names = []
    for node in ast.walk(ast.parse(file.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    within = (name.split(".")[1:] for name in names if name.split(".")[0] == root.name)
    places = [root.joinpath(*parts) for parts in within]
    files = [each for place in places for each in (place.with_suffix(".py"), place / "__init__.py")]
    return tuple(each for each in files if each.is_file())
