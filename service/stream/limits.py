"""What a stream may ask of the service, by ``CAPHY_STREAM_...`` environment variables."""

from __future__ import annotations

from pydantic import Field, ValidationError
from pydantic_settings import BaseSettings, SettingsConfigDict

from caphy.errors import CaphyError
from service.settings import DAY
from service.stream.messages import largest_seen


class StreamLimits(BaseSettings):
    """Limits of the streams of one process."""

    model_config = SettingsConfigDict(env_prefix="CAPHY_STREAM_")

    max_streams: int = Field(default=512, ge=1, le=100_000, description="streams at the same time")
    max_client_streams: int = Field(
        default=128, ge=1, le=100_000, description="streams of one client address at the same time"
    )
    max_frames: int = Field(default=32, ge=1, le=1000, description="most frames of one message, also when resampled")
    max_credits: int = Field(default=64, ge=1, le=65535, description="most answers a client may have open")
    max_message_bytes: int = Field(default=64 << 10, ge=1024, le=1 << 30, description="most bytes of one message")
    max_rate: float = Field(default=300.0, gt=0, le=1e9, description="messages and frames that are read per second")
    burst: float = Field(default=600.0, ge=1, le=1e9, description="messages and frames that may come at once")
    hello_seconds: float = Field(default=10.0, gt=0, le=DAY, description="time to say hello")
    idle_seconds: float = Field(default=120.0, gt=0, le=DAY, description="longest silence of a client")
    send_seconds: float = Field(default=20.0, gt=0, le=DAY, description="longest time a client may take for one answer")


def read_limits() -> StreamLimits:
    """The limits of the environment; raises CaphyError for wrong values."""
    try:
        limits = StreamLimits()
    except ValidationError as error:
        first = error.errors()[0]
        name = "_".join(map(str, first["loc"])).upper()
        raise CaphyError(f"CAPHY_STREAM_{name}: {first['msg']}, got {first['input']!r}") from error
    least = largest_seen(limits.max_frames)
    if limits.max_message_bytes < least:
        raise CaphyError(
            f"CAPHY_STREAM_MAX_FRAMES: {limits.max_frames} frames are {least} bytes, of which a message may have "
            f"{limits.max_message_bytes}; set CAPHY_STREAM_MAX_MESSAGE_BYTES={least}, or fewer frames"
        )
    return limits
