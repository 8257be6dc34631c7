"""The avatars a service offers, loaded and warm."""

from __future__ import annotations

import hashlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

from caphy.errors import CaphyError
from caphy.io.bundle import MANIFEST, AvatarBundle, BundledGarment, read_bundle
from service.engine import GarmentEngine
from service.errors import Problem
from service.huge_pages import onto_huge_pages
from service.metrics import resident_bytes


class Avatar:
    """One bundle and the engines of its garments, in the manifest's order.

    version: names the bundle's content, so it is the same in every process that serves it. loaded_bytes and
    loaded_seconds: what reading it and warming its engines took of memory and time.
    """

    def __init__(self, identifier: str, bundle: AvatarBundle, chunk: int, version: str = "unknown") -> None:
        self.id = identifier
        self.bundle = bundle
        self.version = version
        self.engines = {garment.name: _engine(garment, chunk) for garment in bundle.garments}
        self.loaded_bytes = 0
        self.loaded_seconds = 0.0
        self._made: dict[str, bytes] = {}
        self._lock = threading.Lock()

    def select(self, names: list[str]) -> list[GarmentEngine]:
        """The engines of garments ``names``, all where none are named, in the manifest's order."""
        unknown = [name for name in names if name not in self.engines]
        if unknown:
            raise Problem(404, f"avatar {self.id!r} has no garment {unknown[0]!r}; it has {', '.join(self.engines)}")
        return [engine for name, engine in self.engines.items() if name in names or not names]

    def summary(self) -> dict[str, Any]:
        """Id, name, version, frame rate and garments."""
        return {
            "id": self.id,
            "name": self.bundle.name,
            "version": self.version,
            "fps": self.bundle.fps,
            "garments": [
                {"name": engine.name, "vertices": engine.vertex_count, "state_size": engine.state_size}
                for engine in self.engines.values()
            ],
        }

    def once(self, name: str, make: Callable[[AvatarBundle], bytes]) -> bytes:
        """What ``make`` returns for the bundle; made at the first call under that ``name``, kept for the others."""
        with self._lock:
            if name not in self._made:
                self._made[name] = make(self.bundle)
            return self._made[name]


def _engine(garment: BundledGarment, chunk: int) -> GarmentEngine:
    try:
        return GarmentEngine(garment, chunk)
    except CaphyError as error:
        if garment.name in str(error):
            raise
        raise CaphyError(f"garment {garment.name!r}: {error}") from error


def load_avatar(place: Path, chunk: int) -> Avatar:
    """The bundle in ``place``, warm; raises CaphyError where it is broken."""
    before, started = resident_bytes(), perf_counter()
    try:
        place.name.encode()
    except UnicodeEncodeError as error:
        raise CaphyError(
            f"{os.fsencode(place)!r}: the folder's name must be UTF-8, as it goes into addresses; rename it"
        ) from error
    version = _version(place)
    bundle = read_bundle(place)
    try:
        avatar = Avatar(place.name, bundle, chunk, version)
    except CaphyError as error:
        raise CaphyError(f"{place}: {error}") from error
    # It takes longer than all the rest, and frames need not wait for it.
    threading.Thread(target=onto_huge_pages, daemon=True).start()
    # What was freed before is used again, by which the process need not grow: at least what is held can be counted.
    held = sum(len(garment.onnx) for garment in bundle.garments)
    avatar.loaded_bytes = max(held, resident_bytes() - before)
    avatar.loaded_seconds = perf_counter() - started
    return avatar


def bundle_places(folder: Path) -> list[Path]:
    """The bundles in ``folder``, or ``folder`` itself if it is one; raises CaphyError where there is none."""
    if not folder.is_dir():
        raise CaphyError(f"{folder}: is no folder of avatars; give one with --avatars or CAPHY_AVATARS")
    if (folder / MANIFEST).is_file():
        return [Path(os.path.abspath(folder))]  # "." has a name then, and a link keeps its own
    places = sorted(path.parent for path in folder.glob(f"*/{MANIFEST}") if not path.parent.name.startswith("."))
    if not places:
        raise CaphyError(f"{folder}: holds no avatar bundle; write one there with 'caphy export'")
    return places


def load_avatars(folder: Path, chunk: int) -> dict[str, Avatar]:
    """Every bundle in ``folder``, or ``folder`` itself if it is one, by directory name.

    Raises CaphyError where there is none, or one is broken.
    """
    return {place.name: load_avatar(place, chunk) for place in bundle_places(folder)}


def _version(place: Path) -> str:
    """The manifest's hash: it holds those of all other files."""
    try:
        return hashlib.sha256((place / MANIFEST).read_bytes()).hexdigest()[:12]
    except OSError as error:
        raise CaphyError(f"{place / MANIFEST}: cannot be read ({error.strerror}); copy the bundle again") from error
