"""The avatars a service offers, loaded and warm."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from caphy.errors import CaphyError
from caphy.io.bundle import MANIFEST, AvatarBundle, read_bundle
from service.engine import GarmentEngine
from service.problem import Problem


class Avatar:
    """One bundle and the engines of its garments, in the manifest's order."""

    def __init__(self, identifier: str, bundle: AvatarBundle, chunk: int) -> None:
        self.id = identifier
        self.bundle = bundle
        self.engines = {garment.name: GarmentEngine(garment, chunk) for garment in bundle.garments}

    def select(self, names: list[str]) -> list[GarmentEngine]:
        """The engines of garments ``names``, all where none are named, in the manifest's order."""
        unknown = [name for name in names if name not in self.engines]
        if unknown:
            raise Problem(404, f"avatar {self.id!r} has no garment {unknown[0]!r}; it has {', '.join(self.engines)}")
        return [engine for name, engine in self.engines.items() if name in names or not names]

    def summary(self) -> dict[str, Any]:
        """Id, name, frame rate and garments."""
        return {
            "id": self.id,
            "name": self.bundle.name,
            "fps": self.bundle.fps,
            "garments": [
                {"name": engine.name, "vertices": engine.vertex_count, "state_size": engine.state_size}
                for engine in self.engines.values()
            ],
        }


def load_avatars(folder: Path, chunk: int) -> dict[str, Avatar]:
    """Every bundle in ``folder``, or ``folder`` itself if it is one, by directory name.

    Raises CaphyError where there is none, or one is broken.
    """
    if not folder.is_dir():
        raise CaphyError(f"{folder}: is no folder of avatars; give one with --avatars or CAPHY_AVATARS")
    if (folder / MANIFEST).is_file():
        places = [folder.resolve()]
    else:
        places = sorted(path.parent for path in folder.glob(f"*/{MANIFEST}") if not path.parent.name.startswith("."))
    if not places:
        raise CaphyError(f"{folder}: holds no avatar bundle; write one there with 'caphy export'")
    return {place.name: Avatar(place.name, read_bundle(place), chunk) for place in places}
