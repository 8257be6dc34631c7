"""Runs the networks for several streams."""

from __future__ import annotations

import numpy as np

from service.encodings import Encoding
from service.engine import GarmentEngine
from service.stream.session import Job, Session

Shown = tuple[dict[str, np.ndarray], dict[str, np.ndarray]]
"""Per garment: vertices (N, V, 3), or blend weights (N, R), of all of a job's poses, and the state (S,) after them."""


def run_batch(jobs: list[tuple[Session, Job]]) -> list[Shown]:
    """What the engines of every session answer to its job."""
    return [_run(session, job) for session, job in jobs]


def _run(session: Session, job: Job) -> Shown:
    shown, states = {}, {}
    weights = session.wanted.encoding is Encoding.WEIGHTS
    for engine in session.engines:
        state = session.states[engine.name]
        if len(job.poses):
            run = engine.blend if weights else engine.run
            shown[engine.name], states[engine.name] = run(job.poses, job.transl, state)
        else:
            shown[engine.name], states[engine.name] = _nothing(engine, weights), state
    return shown, states


def _nothing(engine: GarmentEngine, weights: bool) -> np.ndarray:
    return np.zeros((0, engine.weight_count) if weights else (0, engine.vertex_count, 3), np.float32)
