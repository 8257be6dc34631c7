"""Which scans networks have learnt from, as 'caphy train' and 'caphy export' keep it beside them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final

from caphy.errors import CaphyError
from caphy.io.bundle import MANIFEST
from caphy.io.bundled import path_of
from caphy.io.training_folder import OPTIONS, RECORD

TEMPLATES: Final = "garments.json"
"""What templates were chosen, and by which scans."""
CONTENTS: Final = "contents"
"""Digests of what those options name by path, in the same file."""
SCANS_DIGEST: Final = "scans_digest"
"""The digest of the scans in the record that an avatar carries on."""
INIT_SCANS: Final = "init_scans_digests"
"""Digests of the scans that what ``--init`` went on from had learnt from, in the same record."""


def require_same_scans(folder: Path, kinds: Sequence[str], digest: str) -> None:
    """Raise CaphyError where an avatar, or one of the networks ``kinds`` in a folder, learnt from other scans.

    Args:
        digest: of the scans that the run trains on (:func:`caphy.kept.digest` of their points). Networks that learnt
            from no scans may be held against any.
    """
    folders = [folder] if (folder / MANIFEST).is_file() else [folder / kind for kind in kinds]
    for told in [each for one in folders for each in learnt_from(one)]:
        if told != digest:
            raise CaphyError(
                f"{folder}: trained on other scans than split.json names for training now"
                + ("" if told else ", for all that is kept beside it")
                + ", so that it may know those held out; train it again"
            )


def chosen_by_held_out(run: Path, kinds: Sequence[str], held_out: Sequence[str]) -> dict[str, list[str]]:
    """Of each garment of a run, the scans held out by which 'caphy register garments' chose its template."""
    chosen = _json(run / TEMPLATES, "choose templates again with 'caphy register garments'")
    among = {kind: [name for name in held_out if name in chosen.get(kind, {}).get("scans", ())] for kind in kinds}
    return {kind: names for kind, names in among.items() if names}


def learnt_from(folder: Path) -> Iterator[str]:
    """A digest of the scans of each training behind an avatar or a network; empty where it was not kept."""
    if (folder / MANIFEST).is_file():
        for garment in _json(folder / MANIFEST).get("provenance", {}).get("garments", {}).values():
            training = garment.get("training", {})
            if training.get("scans"):
                yield training.get(SCANS_DIGEST, "")
            yield from training.get(INIT_SCANS) or ()
        return
    given = _json(folder / OPTIONS)
    if given.get("scans"):
        yield given.get(CONTENTS, {}).get("scans", "")
    begun = given.get("init") or given.get("transfer")
    if begun:  # what it went on from, or began as, has learnt from scans of its own
        before = _json(folder / RECORD).get(INIT_SCANS)
        yield from learnt_from(path_of(begun, folder.resolve())) if before is None else before


def _json(path: Path, remedy: str = "train again, or take an earlier copy") -> dict[str, Any]:
    try:
        return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    except (OSError, ValueError) as error:
        raise CaphyError(f"{path}: cannot be read as JSON: {error}; {remedy}") from error
