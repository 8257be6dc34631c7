"""The free body that comes with the package (MakeHuman data, CC0; made by ``caphy body build``)."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Final, Literal, get_args

from caphy.body.model import BodyModel

Resolution = Literal["medium", "fine"]
RESOLUTIONS: Final[tuple[Resolution, ...]] = get_args(Resolution)


def default_body_path(resolution: Resolution = "medium") -> Path:
    """Where the bundled file lies."""
    return Path(__file__).parent.parent / "data" / f"body_{resolution}.npz"


@lru_cache(maxsize=2)
def default_body(resolution: Resolution = "medium") -> BodyModel:
    """An average adult: ``medium`` for contact and training, ``fine`` for pictures.

    Both have the same joints and the same shape space, so poses and betas mean the same on either.
    """
    return BodyModel.load(default_body_path(resolution))
