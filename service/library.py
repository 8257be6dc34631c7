"""Which avatars are served: loaded at start, looked for again while running, replaced only by what works."""

from __future__ import annotations

import logging
from pathlib import Path

import anyio
import anyio.to_thread

from caphy.errors import CaphyError
from caphy.io.bundle import MANIFEST
from service.avatars import Avatar, bundle_places, load_avatar
from service.huge_pages import return_freed
from service.metrics import Metrics

log = logging.getLogger("caphy.service")
Signature = tuple[tuple[str, int, int, int], ...]
"""Names, inodes, sizes and times of a bundle's files: changes when any of them does."""


class Library:
    """The avatars of a folder. :attr:`avatars` is replaced as a whole, so whoever reads it sees one state of it."""

    def __init__(self, folder: Path, chunk: int, metrics: Metrics) -> None:
        self.avatars: dict[str, Avatar] = {}
        self._folder = folder
        self._chunk = chunk
        self._metrics = metrics
        self._seen: dict[str, Signature] = {}
        self._missing: set[str] = set()

    def load(self) -> None:
        """Load every bundle; broken ones are logged and left out.

        Raises CaphyError where there is none, or all are broken.
        """
        places = bundle_places(self._folder)
        errors = [error for place in places if (error := self._load(place, _signature(place)))]
        if not self.avatars:
            raise errors[0]

    def look(self) -> None:
        """Load what is new or changed since the last look, withdraw what was gone at this look and the one before."""
        try:
            places = {place.name: place for place in bundle_places(self._folder)}
        except CaphyError:  # not there just now; what is served stays
            return
        for name, place in places.items():
            signature = _signature(place)
            if signature and signature != self._seen.get(name):
                self._load(place, signature)
        missing = set(self.avatars) - set(places)
        gone = missing & self._missing
        for name in () if gone == set(self.avatars) else gone:  # what is there instead is broken
            log.info("avatar withdrawn: its bundle is gone", extra={"avatar": name})
            self.avatars = {key: avatar for key, avatar in self.avatars.items() if key != name}
            self._seen.pop(name, None)
            self._metrics.avatar_bytes.labels(name).set(0)
        self._missing = missing

    async def watch(self, seconds: float) -> None:
        """Look every so many seconds, for ever."""
        while True:
            await anyio.sleep(seconds)
            try:
                await anyio.to_thread.run_sync(self.look)
            except Exception:
                log.exception("looking for new avatars failed")

    def _load(self, place: Path, signature: Signature) -> CaphyError | None:
        self._seen[place.name] = signature
        serving, told = self.avatars.get(place.name), place.name.encode("utf-8", "replace").decode()
        try:
            avatar = load_avatar(place, self._chunk)
        except Exception as broken:  # whatever is wrong with a file must not end the process that serves the others
            error = broken if isinstance(broken, CaphyError) else _unforeseen(place, broken)
            kept = f"version {serving.version} serves on" if serving else "it is not served"
            log.error("avatar refused, %s: %s", kept, error, extra={"avatar": told})
            self._metrics.avatar_loads.labels(told, "refused").inc()
            return error
        facts = {"avatar": place.name, "version": avatar.version, "seconds": round(avatar.loaded_seconds, 3)}
        log.info("avatar loaded", extra={**facts, "megabytes": round(avatar.loaded_bytes / 1e6, 1)})
        self.avatars = {**self.avatars, place.name: avatar}
        if serving is not None:
            del serving
            return_freed()
        self._metrics.avatar_loads.labels(place.name, "loaded").inc()
        self._metrics.avatar_bytes.labels(place.name).set(avatar.loaded_bytes)
        return None


def _unforeseen(place: Path, error: Exception) -> CaphyError:
    log.error("loading %s failed", place.name, exc_info=error)
    return CaphyError(f"{place}: cannot be loaded ({type(error).__name__}: {error}); export the avatar again")


def _signature(place: Path) -> Signature:
    """Of the files in ``place``; empty while there is no manifest among them."""
    try:
        found = [(path.name, path.stat()) for path in sorted(place.iterdir())]
    except OSError:
        return ()
    if MANIFEST not in [name for name, _ in found]:
        return ()
    return tuple((name, stat.st_ino, stat.st_size, stat.st_mtime_ns) for name, stat in found)
