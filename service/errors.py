"""What cannot be answered; clients know it too, so nothing of the web framework is needed here."""

from __future__ import annotations

from collections.abc import Mapping

from caphy.errors import CaphyError


class Problem(CaphyError):
    """A request that cannot be answered; ``status`` is the HTTP status."""

    def __init__(self, status: int, detail: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(detail)
        self.status = status
        self.headers = dict(headers or {})
