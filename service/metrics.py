"""What Prometheus may ask: requests, stages in milliseconds, what is in flight, what was refused, memory.

One process keeps its numbers itself. Several workers share a folder (``PROMETHEUS_MULTIPROC_DIR``, set by
``caphy serve --workers``), and whichever of them is asked answers for all.
"""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Final

import anyio
from fastapi import FastAPI, Response
from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector

MILLISECONDS: Final = (0.1, 0.25, 0.5, 1, 2, 3, 5, 7.5, 10, 15, 20, 33, 50, 100, 250, 500, 1000, 2500, 5000)
"""Upper bounds of the histograms' buckets; 33 ms is a frame at 30 fps."""
BUCKETS: Final = tuple(milliseconds / 1e3 for milliseconds in MILLISECONDS)
MEMORY_SECONDS: Final = 2.0
SHARED_FOLDER: Final = "PROMETHEUS_MULTIPROC_DIR"


class Metrics:
    """The service's numbers; attributes are prometheus_client metrics."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = self._counter("caphy_requests", "HTTP requests answered", "route", "method", "status")
        self.request_seconds = self._histogram("caphy_request_seconds", "From the first byte to the last", "route")
        self.stage_seconds = self._histogram("caphy_stage_seconds", "Share of parse, infer and encode", "stage")
        self.stream_seconds = self._histogram("caphy_stream_seconds", "Share of parse, infer and encode", "stage")
        self.in_flight = self._gauge("caphy_inference_in_flight", "Inferences running or waiting for a thread")
        self.streams = self._gauge("caphy_streams", "WebSocket streams that are open")
        self.buffered = self._gauge("caphy_buffered_bytes", "Bytes of requests and answers held in memory")
        self.frames = self._counter("caphy_frames", "Frames answered", "avatar")
        self.refused = self._counter("caphy_refused", "Requests refused to protect the service", "reason")
        self.avatar_loads = self._counter("caphy_avatar_loads", "Avatar bundles loaded or refused", "avatar", "outcome")
        self.avatar_bytes = self._gauge("caphy_avatar_bytes", "Memory that loading the avatar took", "avatar")
        self.resident_bytes = self._gauge("caphy_resident_bytes", "Memory of the processes")

    def _counter(self, name: str, text: str, *labels: str) -> Counter:
        return Counter(name, text, labels, registry=self.registry)

    def _histogram(self, name: str, text: str, *labels: str) -> Histogram:
        return Histogram(name, text, labels, registry=self.registry, buckets=BUCKETS)

    def _gauge(self, name: str, text: str, *labels: str) -> Gauge:
        return Gauge(name, text, labels, registry=self.registry, multiprocess_mode="livesum")

    async def watch_memory(self) -> None:
        """Note the memory of this process every so often, for ever: another worker may be the one that is asked."""
        while True:
            self.resident_bytes.set(resident_bytes())
            await anyio.sleep(MEMORY_SECONDS)

    def exposition(self) -> bytes:
        """All numbers in Prometheus' text format, of all workers where there are several."""
        if SHARED_FOLDER not in os.environ:
            return generate_latest(self.registry)
        shared = CollectorRegistry()
        MultiProcessCollector(shared)
        return generate_latest(shared)


class Stages:
    """Times stages into a histogram labelled by them: :meth:`time` each, then read :attr:`server_timing`."""

    def __init__(self, histogram: Histogram) -> None:
        self._histogram = histogram
        self._children: dict[str, Histogram] = {}
        self._seconds: dict[str, float] = {}

    @contextmanager
    def time(self, stage: str) -> Iterator[None]:
        """Count the time inside towards ``stage``; what raises is not counted."""
        started = perf_counter()
        yield
        self.observe(stage, perf_counter() - started)

    def observe(self, stage: str, seconds: float) -> None:
        """Count ``seconds`` towards ``stage``."""
        if stage not in self._children:
            self._children[stage] = self._histogram.labels(stage)
        self._children[stage].observe(seconds)
        self._seconds[stage] = seconds

    @property
    def server_timing(self) -> str:
        """The value of a ``server-timing`` header [ms]."""
        return ", ".join(f"{stage};dur={1e3 * seconds:.3f}" for stage, seconds in self._seconds.items())


def resident_bytes() -> int:
    """Memory of this process now; its peak where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return pages * os.sysconf("SC_PAGE_SIZE")


def add_metrics(app: FastAPI, metrics: Metrics) -> None:
    """Mount ``GET /metrics``."""

    @app.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    def exposition() -> Response:
        """Prometheus metrics."""
        return Response(metrics.exposition(), media_type=CONTENT_TYPE_LATEST)
