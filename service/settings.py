"""What an operator may set, by ``CAPHY_...`` environment variables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

import caphy
from caphy.errors import CaphyError

BUNDLED_AVATARS = Path(caphy.__file__).parent / "data" / "avatars"


class Settings(BaseSettings):
    """Limits and places of one service process."""

    model_config = SettingsConfigDict(env_prefix="CAPHY_")

    avatars: Path = Field(BUNDLED_AVATARS, description="folder of avatar bundles, or one bundle")
    host: str = Field("127.0.0.1", description="address to listen on")
    port: int = Field(8000, ge=0, le=65535, description="port to listen on")
    max_frames: int = Field(1800, ge=1, description="most frames of one request, before and after resampling")
    max_json_frames: int = Field(120, ge=1, description="most frames answered as JSON")
    max_body_bytes: int = Field(8 << 20, ge=1024, description="most bytes of one request body")
    chunk_frames: int = Field(8, ge=1, description="frames per run of a network: small chunks stay in cache")
    threads: int = Field(2, ge=1, description="requests computed at the same time")


def read_settings(**given: Any) -> Settings:
    """The settings of the environment, with those ``given`` in their place; raises CaphyError for wrong values."""
    try:
        return Settings(**given)
    except ValidationError as error:
        first = error.errors()[0]
        raise CaphyError(
            f"CAPHY_{'_'.join(map(str, first['loc'])).upper()}: {first['msg']}, got {first['input']!r}"
        ) from error
