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

NAME = "sealed.json"


def seal(answer: Mapping[str, Any]) -> tuple[str, str]:
    """Text of the sealed file, and the hash that commits to it.

    The answer is packed, not encrypted: whoever wants to cheat can. The hash covers a random salt, so that it cannot
    be found by trying all answers.
    """
    content = json.dumps({"salt": secrets.token_hex(16), "answer": dict(answer)}, sort_keys=True).encode()
    digest = hashlib.sha256(content).hexdigest()
    packed = base64.b85encode(zlib.compress(content)).decode("ascii")
    return json.dumps({"schema": "caphy-challenge-1", "sha256": digest, "sealed": packed}, indent=1), digest


def opened(folder: Path) -> dict[str, Any]:
    """The answer in a challenge's folder; raises :class:`CaphyError` if it is missing or was tampered with."""
    path = folder / NAME
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        content = zlib.decompress(base64.b85decode(document["sealed"]))
        answer = json.loads(content)["answer"]
    except OSError as error:
        raise CaphyError(f"{path}: cannot be read: {error.strerror}; make one with caphy challenge new") from error
    except (ValueError, KeyError, TypeError, zlib.error) as error:
        raise CaphyError(f"{path}: is no sealed answer of a challenge: {error!r}") from error
    if hashlib.sha256(content).hexdigest() != document["sha256"]:
        raise CaphyError(f"{path}: the answer does not match its hash; it was changed after it was sealed")
    return answer
