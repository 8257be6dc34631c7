"""Bodies in JSON: counted before they are parsed, for the parser holds the interpreter's lock while it works."""

from __future__ import annotations

from typing import Final, TypeVar

from pydantic import BaseModel, ValidationError

from service.errors import Problem

Model = TypeVar("Model", bound=BaseModel)
MOST_MEMBERS: Final = 1000
"""Names in all objects of a body; no request has a tenth of them."""
FRAME_VALUES: Final = 300
"""Numbers and lists of one frame: poses, translation, time and confidence have 282."""


def validated(model: type[Model], body: bytes, frames: int, state_size: int) -> Model:
    """The ``model`` in a body of at most ``frames`` frames and a state of ``state_size`` numbers.

    Raises Problem 413 where it holds more than those have, 422 naming the first thing that is wrong. Lists in ``model``
    must be ``fail_fast``: pydantic tells of every number that is none, a kilobyte for each.
    """
    most = FRAME_VALUES * frames + state_size + MOST_MEMBERS
    values = sum(body.count(mark) for mark in (b",", b"[", b"{"))
    if values > most or body.count(b":") > MOST_MEMBERS:
        raise Problem(
            413, f"a body in JSON may hold {most} values and {MOST_MEMBERS} names, enough for {frames} frames, got "
            f"{values} and {body.count(b':')}; send fewer frames",
        )  # fmt: skip
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))[:100] or "the body"
        unknown = first["type"] == "extra_forbidden"
        raise Problem(422, f"{where}: {'is not known here; leave it out' if unknown else first['msg']}") from error
