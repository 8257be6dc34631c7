"""Runs the networks for one stream."""

from __future__ import annotations

import numpy as np

from service import frames
from service.encodings import Encoding, Meshes
from service.engine import GarmentEngine
from service.stream.session import Job, Session


def compute(session: Session, job: Job) -> bytes | None:
    """The message that answers a job, if one does. Raises Problem where a network left the finite numbers."""
    shown, states = {}, {}
    for engine in session.engines:
        name, weights = engine.name, session.wanted.encoding is Encoding.WEIGHTS
        if len(job.poses):
            run = engine.blend if weights else engine.run
            shown[name], states[name] = run(job.poses, job.transl, session.states[name])
            frames.require_finite(name, shown[name], states[name])
        else:
            shown[name], states[name] = _nothing(engine, weights), session.states[name]
    return session.finish(job, _meshes(session, job, shown), states)


def _meshes(session: Session, job: Job, shown: dict[str, np.ndarray]) -> Meshes:
    if job.answered is None:
        return Meshes(0)
    part = slice(job.shown, None)
    kept = {name: array[part] for name, array in shown.items()}
    return frames.packed(session.engines, job.poses[part], job.transl[part], kept, session.wanted, session.pelvis)


def _nothing(engine: GarmentEngine, weights: bool) -> np.ndarray:
    return np.zeros((0, engine.weight_count) if weights else (0, engine.vertex_count, 3), np.float32)
