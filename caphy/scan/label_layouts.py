"""What the classes of published human parsers are, how their input must look, and which label each class has."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, Literal

from caphy.errors import CaphyError
from caphy.scan.scan import LABEL_NAMES

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of red, green and blue in 0 to 1."""


@dataclass(frozen=True)
class LabelLayout:
    """One family of parsers."""

    classes: tuple[str, ...]
    """Names of the output's channels, in order."""
    upper: tuple[str, ...]
    """Classes that are the upper garment; a dress counts as upper, as does what is worn over it."""
    lower: tuple[str, ...]
    """Classes that are the lower garment."""
    backdrop: tuple[str, ...]
    """Classes that are no part of the person, or say nothing of it."""
    size: tuple[int, int]
    """Height and width of the input."""
    mean: tuple[float, float, float] = IMAGENET_MEAN
    std: tuple[float, float, float] = IMAGENET_STD
    order: Literal["rgb", "bgr"] = "rgb"
    """Order of the input's channels; ``mean`` and ``std`` are of red, green, blue all the same."""
    source: str = ""

    def __post_init__(self) -> None:
        for name in (*self.upper, *self.lower, *self.backdrop):
            if name not in self.classes:
                raise CaphyError(f"the class {name!r} must be one of the layout's classes: {', '.join(self.classes)}")

    @property
    def label_of_class(self) -> list[int]:
        """For each class the label's number, or -1 for the backdrop."""
        groups = {**dict.fromkeys(self.upper, 1), **dict.fromkeys(self.lower, 2), **dict.fromkeys(self.backdrop, -1)}
        return [groups.get(name, LABEL_NAMES.index("body")) for name in self.classes]


_ATR: Final = (
    *("background", "hat", "hair", "sunglasses", "upper-clothes", "skirt", "pants", "dress", "belt"),
    *("left-shoe", "right-shoe", "face", "left-leg", "right-leg", "left-arm", "right-arm", "bag", "scarf"),
)
_LIP: Final = (
    *("background", "hat", "hair", "glove", "sunglasses", "upper-clothes", "dress", "coat", "socks", "pants"),
    *("jumpsuits", "scarf", "skirt", "face", "left-arm", "right-arm", "left-leg", "right-leg"),
    *("left-shoe", "right-shoe"),
)
_GOLIATH: Final = (
    *("background", "apparel", "face-neck", "hair", "left-foot", "left-hand", "left-lower-arm", "left-lower-leg"),
    *("left-shoe", "left-sock", "left-upper-arm", "left-upper-leg", "lower-clothing", "right-foot", "right-hand"),
    *("right-lower-arm", "right-lower-leg", "right-shoe", "right-sock", "right-upper-arm", "right-upper-leg"),
    *("torso", "upper-clothing", "lower-lip", "upper-lip", "lower-teeth", "upper-teeth", "tongue"),
)
_SCHP: Final = "Li et al., Self-Correction for Human Parsing, TPAMI 2020; PeikeLi/Self-Correction-Human-Parsing"

LAYOUTS: Final[Mapping[str, LabelLayout]] = {
    "schp-lip": LabelLayout(
        _LIP,
        upper=("upper-clothes", "dress", "coat", "jumpsuits", "scarf"),
        lower=("pants", "skirt"),
        backdrop=("background",),
        size=(473, 473),
        order="bgr",
        source=f"{_SCHP}, dataset LIP",
    ),
    "schp-atr": LabelLayout(
        _ATR,
        upper=("upper-clothes", "dress", "scarf"),
        lower=("skirt", "pants", "belt"),
        backdrop=("background", "bag"),
        size=(512, 512),
        order="bgr",
        source=f"{_SCHP}, dataset ATR",
    ),
    "segformer-clothes": LabelLayout(
        _ATR,
        upper=("upper-clothes", "dress", "scarf"),
        lower=("skirt", "pants", "belt"),
        backdrop=("background", "bag"),
        size=(512, 512),
        source="mattmdjaga/segformer_b2_clothes, labels of ATR",
    ),
    "sapiens": LabelLayout(
        _GOLIATH,
        upper=("upper-clothing",),
        lower=("lower-clothing",),
        backdrop=("background", "apparel"),
        size=(1024, 768),
        source="Khirodkar et al., Sapiens, ECCV 2024; facebookresearch/sapiens, docs/SEG_README.md, 28 classes",
    ),
}


def find_layout(name: str) -> LabelLayout:
    """A layout by name, or from a JSON file with the fields of :class:`LabelLayout`."""
    if name in LAYOUTS:
        return LAYOUTS[name]
    path = Path(name)
    if not path.is_file():
        raise CaphyError(f"{name}: is neither a known label layout ({', '.join(LAYOUTS)}) nor a JSON file with one")
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        known = {field.name for field in fields(LabelLayout)}
        if strange := sorted(set(given) - known):
            raise ValueError(f"{strange[0]!r} is none of {', '.join(sorted(known))}")
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
        return LabelLayout(**values)
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise CaphyError(f"{path}: must be a JSON object with the fields of a label layout: {error}") from error
