"""Stages one after another: those that are done already are passed over, and what is left is estimated."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic

from caphy.errors import CaphyError
from caphy.kept import own_code
from caphy.pipeline.ledger import Entry, Ledger
from caphy.pipeline.log import logged
from caphy.pipeline.stage import Stage

PRIOR = 60.0
"""Seconds of work at the expected pace that are believed in before anything was measured."""


@dataclass
class Pace:
    """How long things take here against what they should."""

    expected: float = 0.0
    taken: float = 0.0

    def add(self, stage: Stage, seconds: float) -> None:
        """A stage was done in so many seconds."""
        if not stage.timed:
            self.expected, self.taken = self.expected + stage.seconds, self.taken + seconds

    def left(self, stages: Sequence[Stage]) -> float:
        """Seconds that stages will take."""
        ratio = (self.taken + PRIOR) / (self.expected + PRIOR)
        return sum(stage.seconds * (1.0 if stage.timed else ratio) for stage in stages)


@dataclass
class Outcome:
    """What came of a run: names of stages done now, done before, and failed with the reason."""

    done: list[str] = field(default_factory=list)
    kept: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    """Of every stage that is done, from its last start."""


def run_stages(stages: Sequence[Stage], run: Path, say: Callable[[str], None] = print) -> Outcome:
    """Bring a run's folder up to date.

    A stage's inputs are looked at when its turn comes, so that they may be outputs of those before it.

    Raises:
        CaphyError: a stage failed that the rest needs; what was done is kept.
    """
    ledger, outcome, pace = Ledger(run), Outcome(), Pace()
    ledger.require_known(stages)
    for number, stage in enumerate(stages):
        head = f"[{number + 1} of {len(stages)}] {stage.what}"
        if ledger.up_to_date(stage):
            outcome.kept.append(stage.name)
            outcome.seconds[stage.name] = _seconds(ledger, stage)
            pace.add(stage, outcome.seconds[stage.name])
            say(f"{head}: done before{_by(ledger, stage)}")
            continue
        left = _left(stages[number:], ledger)
        say(f"{head}; about {_minutes(pace.left([stage]))}, {_minutes(pace.left(left))} for all that is left")
        if (changed := ledger.changed(stage)) is not None:
            say(f"  made anew, and what it left before removed, for {_these(changed)} not as before")
        for telling in stages:
            if telling.of_all and telling is not stage:
                ledger.forget(telling)
        ledger.begin(stage)
        _run(stage, ledger, outcome, say)
        if stage.name in outcome.seconds:
            pace.add(stage, outcome.seconds[stage.name])
    return outcome


def _run(stage: Stage, ledger: Ledger, outcome: Outcome, say: Callable[[str], None]) -> None:
    started = monotonic()
    key, parts = stage.key(), stage.parts()
    try:
        with logged(ledger.log(stage)):
            stage.run()
        missing = [path for path in stage.outputs if not path.exists()]
        if missing:
            raise CaphyError(f"{stage.name}: did not write {missing[0]}")
        if not stage.whole():
            raise CaphyError(f"{stage.name}: did not write all that belongs to {stage.outputs[0]}")
    except CaphyError as error:
        ledger.write(stage, Entry(key, False, monotonic() - started, str(error), parts=parts))
        with ledger.log(stage).open("a", encoding="utf-8") as log:
            log.write(f"failed: {error}\n")
        if not stage.may_fail:
            raise CaphyError(
                f"stage {stage.name}: {error}\nWhat was done before it is kept, and the same command goes on from "
                f"there; its log is {ledger.log(stage)}"
            ) from error
        outcome.failed[stage.name] = str(error)
        say(f"{stage.name}: failed, going on without it: {error}")
        return
    seconds = monotonic() - started
    ledger.write(stage, Entry(key, True, seconds, code=own_code(), parts=parts))
    outcome.done.append(stage.name)
    outcome.seconds[stage.name] = seconds


def _these(changed: Sequence[str]) -> str:
    """What is not as before, with its verb; three by name."""
    if not changed:
        return "what it depends on is"
    more = [] if len(changed) <= 3 else [f"{len(changed) - 3} more"]
    return f"{', '.join([*changed[:3], *more])} {'is' if len(changed) == 1 else 'are'}"


def _seconds(ledger: Ledger, stage: Stage) -> float:
    entry = ledger.entry(stage)
    return entry.seconds if entry else 0.0


def _by(ledger: Ledger, stage: Stage) -> str:
    """A remark where other code of caphy did it, or the same on other data that come with it, such as the default
    avatar: what took hours is not thrown away for every line that changes."""
    entry = ledger.entry(stage)
    same = entry is not None and entry.code == own_code()
    by = "by other code of caphy or on other data that come with it"
    return "" if same else f", {by}; give another folder for the run to do it by these"


def _left(stages: Sequence[Stage], ledger: Ledger) -> list[Stage]:
    """The first stage and all that it leads to, for the estimate: what is made anew may turn out the same, and then
    less is left."""
    left, anew = [stages[0]], list(stages[0].outputs)
    for stage in stages[1:]:
        entry = ledger.entry(stage)
        after = any(path.is_relative_to(made) for path in stage.inputs for made in anew)
        if after or entry is None or not entry.finished:
            left.append(stage)
            anew += stage.outputs
    return left


def _minutes(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
