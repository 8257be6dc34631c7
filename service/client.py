"""A client in a few lines, without dependencies but numpy.

client = Client("http://127.0.0.1:8000")
meshes = client.frames("default", read_poses("walk.npz"))  # {"tshirt": (T, V, 3), "trousers": (T, V, 3)}
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from typing import Any, Final
from urllib.parse import quote, urlencode

import numpy as np

from caphy.conditioning import as_seen
from caphy.errors import CaphyError
from caphy.io.poses import PoseSequence
from service.clients import given
from service.conditioned import HEADER, OFF
from service.encodings import EncodingName
from service.protocol import MEDIA_TYPE, FramesRequest, FramesResponse, decode_response, encode_request

PART: Final = 900
"""Frames that :meth:`Client.frames` sends at once; a service answers 1,800 unless it is set otherwise."""


class Client:
    """Talks to one service over one connection that is kept open; not for several threads at once.

    Every method raises CaphyError with the service's own words where it refuses, or where it cannot be reached.
    """

    def __init__(self, url: str, timeout: float = 60.0, key: str | None = None) -> None:
        """``url`` may end in a path, below which the service then is. ``key``: one of the service's keys, where it
        wants one."""
        parts = given.address(url, ("http", "https"))
        kind = HTTPSConnection if parts.scheme == "https" else HTTPConnection
        self._connection = kind(parts.hostname or "", parts.port, timeout=timeout)
        self._url, self._root = url.rstrip("/"), parts.path.rstrip("/")
        self._headers = {name: value.encode() for name, value in given.headers("x-api-key", "", key).items()}
        self._avatars: dict[str, dict[str, Any]] = {}
        self._told = ""
        self.server_timing: dict[str, float] = {}
        """Milliseconds the service spent on the last :meth:`run`: parse, infer, encode."""

    def avatars(self) -> list[dict[str, Any]]:
        """What the service offers."""
        return self._table("/avatars", list)

    def describe(self, avatar: str) -> dict[str, Any]:
        """One avatar: garments, joints, licence, provenance, metrics."""
        return self._table(f"/avatars/{quote(avatar, safe='')}", dict)

    def pelvis(self, avatar: str) -> np.ndarray:
        """Where the avatar's pelvis joint rests (3,) [m]: what the translations that travel refer to."""
        return np.array(self._known(avatar)["joints"][0])

    def _known(self, avatar: str) -> dict[str, Any]:
        """As :meth:`describe`, asked for once a motion."""
        if avatar not in self._avatars:
            self._avatars[avatar] = self.describe(avatar)
        return self._avatars[avatar]

    def frames(self, avatar: str, sequence: PoseSequence, garments: Sequence[str] = ()) -> dict[str, np.ndarray]:
        """Vertices (T, V, 3) [m] per garment, at the avatar's frame rate, of a motion that starts here.

        It is resampled here, and goes in parts where that makes more than :data:`PART` frames.
        """
        whole, states, parts = sequence.resample(self.describe(avatar)["fps"]), None, []
        for first in range(0, len(whole), PART):
            answer = self.run(avatar, whole[first : first + PART], garments, states)
            parts.append(answer.vertices)
            states = answer.states
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}

    def run(
        self,
        avatar: str,
        sequence: PoseSequence,
        garments: Sequence[str] = (),
        states: Mapping[str, np.ndarray] | None = None,
        encoding: EncodingName = "float32",
        normals: bool = False,
        condition: Mapping[str, Any] | None = None,
    ) -> FramesResponse:
        """As :meth:`frames` in one request, with the states after the last frame; give them to continue a motion.

        Of a motion of another body each root stands where it stood, see :meth:`PoseSequence.about`.
        ``encoding`` and ``normals`` choose what travels, see docs/protocol.md. ``condition``: settings of conditioning
        as in docs/conditioning.md, {} for its defaults; the answer's ``conditioning`` then says what was done.
        ``states`` are those of the garments asked for, in any order.
        """
        if not states:  # a motion starts, and the avatar may be another than that of the last one
            self._avatars.pop(avatar, None)
        if condition is not None:
            sequence, condition = as_seen(sequence), {"frame": sequence.frame, **condition}
        elif sequence.frame == "camera":
            raise CaphyError(
                f"{sequence.source}: these poses are in a camera's frame, so nobody knows which way cloth falls; "
                "convert them to world coordinates first ('caphy poses condition'), or ask for conditioning"
            )
        else:
            sequence = sequence.to_y_up()
        known = self._known(avatar)
        sequence = sequence.about(np.array(known["joints"][0]))
        sizes = {g["name"]: g["state_size"] for g in known["garments"] if not garments or g["name"] in garments}
        state = given.joined(states, sizes) if states else np.zeros(0, np.float32)
        sure = None if condition is None or sequence.unseen is None else (1 - sequence.unseen).astype(np.float32)
        body = encode_request(FramesRequest(sequence.poses, sequence.transl, sequence.fps, state, confidence=sure))
        chosen = [("garment", name) for name in garments]
        chosen += [("encoding", encoding)] * (encoding != "float32") + [("normals", "true")] * normals
        chosen += [] if condition is None else [("condition", given.settings(condition))]
        query = urlencode(chosen)
        path = f"/avatars/{quote(avatar, safe='')}/frames" + (f"?{query}" if query else "")
        answered = decode_response(self._ask("POST", path, body))
        return replace(answered, conditioning=None if self._told in ("", OFF) else json.loads(self._told))

    def _table(self, path: str, kind: type) -> Any:
        """What the service says in JSON."""
        content = self._ask("GET", path)
        try:
            told = json.loads(content)
        except ValueError:
            told = None
        if not isinstance(told, kind) or not (told == [] or _is_caphys(told)):
            raise CaphyError(f"{self._url}{path}: what answers there is not 'caphy serve': {content[:40]!r}")
        return told

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _ask(self, method: str, path: str, body: bytes | None = None) -> bytes:
        try:
            response, content = self._exchange(method, path, body)
        except (OSError, HTTPException, UnicodeError) as error:  # the last are names that no host can have
            self._connection.close()
            raise CaphyError(f"{self._url}: cannot be reached ({error}); is 'caphy serve' running there?") from error
        if response.status != 200:
            raise CaphyError(f"{self._url}{path}: {_detail(content)} (HTTP {response.status})")
        self.server_timing = _timing(response.getheader("server-timing") or "")
        self._told = response.getheader(HEADER) or ""
        return content

    def _exchange(self, method: str, path: str, body: bytes | None) -> tuple[HTTPResponse, bytes]:
        """An answer and its content, over a new connection where the old one has ended meanwhile.

        Services end connections that are silent for some seconds. A request carries all that it needs, so it may be
        sent again. Raises OSError or HTTPException where a new connection does not help.
        """
        headers = {"accept": "application/json"} if body is None else {"content-type": MEDIA_TYPE, "accept": MEDIA_TYPE}
        was_open = self._connection.sock is not None
        try:
            self._connection.request(method, self._root + path, body, headers | self._headers)
            response = self._connection.getresponse()
        except (ConnectionResetError, BrokenPipeError):  # RemoteDisconnected is the first
            self._connection.close()
            if not was_open:
                raise
            return self._exchange(method, path, body)
        return response, response.read()


def _is_caphys(told: Any) -> bool:
    """Whether this can be an avatar, or a list of avatars."""
    each = told[0] if isinstance(told, list) else told
    return isinstance(each, dict) and {"id", "fps", "garments"} <= set(each)


def _detail(content: bytes) -> str:
    try:
        return str(json.loads(content)["detail"])
    except (ValueError, KeyError, TypeError):
        return content[:200].decode("utf-8", "replace")


def _timing(header: str) -> dict[str, float]:
    stages = (stage.strip().partition(";dur=") for stage in header.split(",") if ";dur=" in stage)
    return {name: float(milliseconds) for name, _, milliseconds in stages}
