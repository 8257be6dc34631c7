"""The answer of a challenge, sealed: not readable at a glance, and provably not changed afterwards."""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from caphy.errors import CaphyError
from caphy.io.places import write_text

NAME = "sealed.json"
KEYS = ("hidden", "effects", "outside", "verdict", "alike")
"""What every answer says."""


def seal(answer: Mapping[str, Any]) -> tuple[str, str]:
    """Text of the sealed file, and the hash that commits to it.

    The answer is packed, not encrypted: whoever wants to cheat can. The hash covers a random salt, so that it cannot
    be found by trying all answers.
    """
    content = json.dumps({"salt": secrets.token_hex(16), "answer": dict(answer)}, sort_keys=True).encode()
    digest = hashlib.sha256(content).hexdigest()
    packed = base64.b85encode(zlib.compress(content)).decode("ascii")
    return json.dumps({"schema": "caphy-challenge-1", "sha256": digest, "sealed": packed}, indent=1), digest


def sealed_in(folder: Path, answer: Mapping[str, Any]) -> str:
    """The hash of an answer sealed in a folder: as it was said where this answer is sealed there already, or a new one.

    Raises :class:`CaphyError` where it cannot be written.
    """
    try:
        there, digest = opened(folder)
        if there == json.loads(json.dumps(dict(answer))):
            return digest
    except CaphyError:
        pass
    text, digest = seal(answer)
    write_text(folder / NAME, text)
    return digest


def opened(folder: Path) -> tuple[dict[str, Any], str]:
    """The answer in a challenge's folder and its hash; raises :class:`CaphyError` if it is missing or does not match.

    Whoever writes another answer writes another hash: it must be the one that was said when the challenge was made.
    """
    path = folder / NAME
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        content = zlib.decompress(base64.b85decode(document["sealed"]))
        answer, digest = json.loads(content)["answer"], document["sha256"]
        if missing := [key for key in KEYS if key not in answer]:
            raise KeyError(*missing)
    except OSError as error:
        raise CaphyError(f"{path}: cannot be read: {error.strerror}; make one with caphy challenge new") from error
    except (ValueError, KeyError, TypeError, zlib.error) as error:
        raise CaphyError(f"{path}: is no sealed answer of a challenge: {error!r}") from error
    if hashlib.sha256(content).hexdigest() != digest:
        raise CaphyError(f"{path}: the answer does not match its hash; it was changed after it was sealed")
    return answer, digest
