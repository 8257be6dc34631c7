"""Runs the networks for streams: those that want one frame each together, so that weights are read once for all."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from time import perf_counter

import numpy as np

from service import frames
from service.encodings import Encoding, Meshes
from service.engine import GarmentEngine
from service.errors import Problem
from service.metrics import Stages
from service.settling import run_settling
from service.stream.session import Job, Session

Answer = bytes | Exception | None
"""What a job came to: the message that answers it, why its stream ends, or nothing to say."""


class Work:
    """One stream's job, and what the networks made of it so far, by garment."""

    def __init__(self, session: Session, job: Job) -> None:
        self.session, self.job = session, job
        self.weights = session.wanted.encoding is Encoding.WEIGHTS
        self.shown: dict[str, np.ndarray] = {}
        self.states: dict[str, np.ndarray] = {}
        self.failure: Exception | None = None

    def set(self, engine: GarmentEngine, shown: np.ndarray, state: np.ndarray) -> None:
        """Take in what a network answered; where it left the finite numbers the stream fails."""
        try:
            frames.require_finite(engine.name, shown, state)
        except Problem as problem:
            self.failure = problem
        self.keep(engine, shown, state)

    def keep(self, engine: GarmentEngine, shown: np.ndarray, state: np.ndarray) -> None:
        """Take in what a network answered, known to be finite."""
        self.shown[engine.name], self.states[engine.name] = shown, state

    def run(self, engine: GarmentEngine) -> None:
        """Run one garment's network for this stream alone."""
        state = self.session.states[engine.name]
        if not len(self.job.poses):
            self.set(engine, _nothing(engine, self.weights), state)
            return
        try:
            job = self.job
            self.set(engine, *run_settling(engine, self.weights, job.poses, job.transl, state, job.settle))
        except Exception as error:  # one stream's end, not the others'
            self.failure = error

    def answer(self) -> Answer:
        """The message that answers the job, once every garment's network has run."""
        if self.failure is not None:
            return self.failure
        try:
            return self.session.finish(self.job, self._meshes(), self.states)
        except Exception as error:
            return error

    def _meshes(self) -> Meshes:
        if self.job.answered is None:
            return Meshes(0)
        session, part = self.session, slice(self.job.shown, None)
        kept = {name: array[part] for name, array in self.shown.items()}
        return frames.packed(
            session.engines, self.job.poses[part], self.job.transl[part], kept, session.wanted, session.pelvis
        )


def compute(jobs: Sequence[tuple[Session, Job]], stages: Stages) -> list[Answer]:
    """What each of the jobs, of different streams, comes to."""
    works = [Work(session, job) for session, job in jobs]
    groups: dict[tuple[GarmentEngine, bool], list[Work]] = defaultdict(list)
    for work in works:
        for engine in work.session.engines:
            groups[engine, work.weights].append(work)
    with stages.time("infer"):
        for (engine, weights), members in groups.items():
            _run(engine, weights, members)
    with stages.time("encode"):
        answers = [work.answer() for work in works]
    for work in works:
        if work.job.answered is not None:
            stages.observe("answer", perf_counter() - work.job.answered.arrived)
    return answers


def _run(engine: GarmentEngine, weights: bool, works: list[Work]) -> None:
    joined = [work for work in works if len(work.job.poses) == 1 and not work.job.settle]
    alone = [work for work in works if work not in joined]
    if len(joined) < 2 or not _run_together(engine, weights, joined):
        alone = works
    for work in alone:
        work.run(engine)


def _run_together(engine: GarmentEngine, weights: bool, works: list[Work]) -> bool:
    """Run one frame each; where that fails each must be run alone, so that only the stream ends whose fault it is."""
    poses, transl = (np.concatenate([getattr(work.job, name) for work in works]) for name in ("poses", "transl"))
    states = np.stack([work.session.states[engine.name] for work in works])
    try:
        shown, after = engine.run_together(poses, transl, states, weights)
    except Exception:
        return False
    finite = bool(np.isfinite(shown).all() and np.isfinite(after).all())  # nearly always: one look for all
    for i, work in enumerate(works):
        (work.keep if finite else work.set)(engine, shown[i : i + 1], after[i].copy())
    return True


def _nothing(engine: GarmentEngine, weights: bool) -> np.ndarray:
    return np.zeros((0, engine.weight_count) if weights else (0, engine.vertex_count, 3), np.float32)
