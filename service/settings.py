"""What an operator may set, by ``CAPHY_...`` environment variables; docs/operation.md explains them."""

from __future__ import annotations

import re
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, SecretStr, ValidationError, field_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

import caphy
from caphy.errors import CaphyError

DAY = 86_400
"""Longest time of any limit [s]."""
BUNDLED_AVATARS = Path(caphy.__file__).parent / "data" / "avatars"


class Settings(BaseSettings):
    """Limits and places of one service process."""

    model_config = SettingsConfigDict(env_prefix="CAPHY_")

    avatars: Path = Field(BUNDLED_AVATARS, description="folder of avatar bundles, or one bundle")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on")
    workers: int = Field(1, ge=1, le=256, description="processes that share the port")
    api_key: SecretStr | None = Field(None, description="what clients must send; several, comma-separated")
    allow_anonymous: bool = Field(False, description="answer without a key on addresses beyond this machine")
    origins: str = Field("", description="web pages that may ask, as https://example.org, comma-separated; * for all")
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="least level that is logged")
    reload_seconds: float = Field(
        2.0, ge=0, le=DAY, description="how often to look for new avatar bundles [s]; 0 is never"
    )
    drain_seconds: int = Field(
        30, ge=0, le=DAY, description="how long to finish what is in flight when told to stop [s]"
    )

    max_frames: int = Field(
        1800, ge=1, le=100_000, description="most frames of one request, before and after resampling"
    )
    max_json_frames: int = Field(120, ge=1, le=100_000, description="most frames answered as JSON")
    max_body_bytes: int = Field(8 << 20, ge=1024, le=1 << 34, description="most bytes of one request body")
    max_buffered_bytes: int = Field(
        512 << 20, ge=1024, le=1 << 40, description="most bytes of requests and answers held at once"
    )
    max_connections: int = Field(500, ge=1, le=1_000_000, description="most connections of one process")
    max_waiting: int = Field(
        64, ge=0, le=100_000, description="most requests that wait for a thread; more are told to retry"
    )
    max_wait_seconds: float = Field(2.0, gt=0, le=DAY, description="longest wait for a thread [s]")
    max_client_requests: int = Field(
        32, ge=1, le=100_000, description="most requests of one client that are answered at once"
    )
    max_client_rate: float = Field(2000.0, gt=0, le=1e9, description="most requests of one client per second")
    header_seconds: float = Field(10.0, gt=0, le=DAY, description="time to send a request's header [s]")
    body_seconds: float = Field(20.0, gt=0, le=DAY, description="time to send a request's body [s]")
    send_seconds: float = Field(60.0, gt=0, le=DAY, description="time to take an answer [s]")

    chunk_frames: int = Field(32, ge=1, le=1024, description="frames per run of a network: beyond, nothing is gained")
    threads: int = Field(2, ge=1, le=1024, description="requests computed at the same time")

    @field_validator("api_key")
    @classmethod
    def _not_empty(cls, key: SecretStr | None) -> SecretStr | None:
        if key is not None and not all(_keys(key)):
            raise ValueError("no key must be empty; leave the variable out to have none")
        return key

    @field_validator("origins")
    @classmethod
    def _are_origins(cls, origins: str) -> str:
        for origin in _listed(origins):
            if origin != "*" and not _ORIGIN.fullmatch(origin):
                raise ValueError("an origin is a scheme and a host, as https://example.org or http://localhost:5173")
        return origins

    def allowed_origins(self) -> list[str]:
        """Origins of web pages that may ask; none where only the service's own page may."""
        return _listed(self.origins)

    def api_keys(self) -> list[str]:
        """The keys of which clients must send one; none where anybody may ask."""
        return [] if self.api_key is None else _keys(self.api_key)

    def require_key_beyond_loopback(self) -> None:
        """Raise CaphyError where anybody on the network could use the service without a key, and nobody said so."""
        if self.api_key is None and not self.allow_anonymous and not _is_loopback(self.host):
            raise CaphyError(
                f"listening on {self.host} lets others in, so there must be a key: set CAPHY_API_KEY, "
                "or CAPHY_ALLOW_ANONYMOUS=true where something in front of the service checks who asks"
            )


_ORIGIN = re.compile(r"https?://[^/\s,]+")


def _listed(joined: str) -> list[str]:
    return [each for each in map(str.strip, joined.split(",")) if each]


def _keys(joined: SecretStr) -> list[str]:
    return [key.strip() for key in joined.get_secret_value().split(",")]


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def read_settings(**given: Any) -> Settings:
    """The settings of the environment, with those ``given`` in their place; raises CaphyError for wrong values."""
    try:
        return Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(map(str, first["loc"])).upper()
        shown = "" if name == "API_KEY" else f", got {first['input']!r}"
        raise CaphyError(f"CAPHY_{name}: {first['msg']}{shown}") from error
