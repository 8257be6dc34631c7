"""What a record says of the garments that a command was not given: doing one at a time must not lose the other."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any


def still_told(record: Path, made: Mapping[str, Path], *keys: str) -> dict[str, Any]:
    """The entries of a JSON record for garments whose file, ``made`` by an earlier run, is still there.

    Args:
        made: the file that an entry tells of, by kind of garment.
        keys: lead to where the record has its entries.
    """
    there = [kind for kind, path in made.items() if path.is_file()]
    if not there or not record.is_file():
        return {}
    try:
        entries = json.loads(record.read_text(encoding="utf-8"))
        for key in keys:
            entries = entries[key]
        return {kind: entries[kind] for kind in there if kind in entries}
    except (OSError, ValueError, KeyError, TypeError) as error:
        lost = " and ".join(there)
        print(f"note: {record}: cannot be read ({error!r}): what it said of the {lost} garment is lost; do it again")
        return {}
