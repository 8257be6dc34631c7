"""``caphy capture-sim OUT``: scans of a simulated person in simulated clothes, with the truth kept aside."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from caphy.capture.optics import Optics
from caphy.commands.following import following
from caphy.errors import CaphyError
from caphy.io.places import writable_folder


@dataclass(frozen=True)
class CaptureSim:
    """Scan a simulated person: OUT/scans for the pipeline, OUT/truth to judge it by. Resumes where it was stopped."""

    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write; one that was begun with the same options is completed."""
    poses: Path | None = None
    """Folder of motion capture to take stills from; procedural motions unless given."""
    count: int = 80
    """Number of scans; the first is the A-pose."""
    seed: int = 0
    """Body, clothes, fabrics, colours, poses and noise all follow from it."""
    upper: Literal["tshirt", "longsleeve", "tank"] | None = None
    """Upper garment; drawn from the seed unless given."""
    lower: Literal["trousers", "shorts", "skirt"] | None = None
    """Lower garment; drawn from the seed unless given."""
    body: Literal["medium", "fine"] = "fine"
    """Bundled body under the clothes."""
    edge_length: float = 0.018
    """Target edge length of the simulated clothes [m]."""
    simulate: bool = True
    """Drape with the reference solver; --no-simulate lets clothes follow the skeleton, which is quick and wrong."""
    pose_error: float = 20.0
    """How far each joint of the initial poses in OUT/scans/poses.npz is off [degrees]."""
    optics: Optics = field(default_factory=Optics)


def main(arguments: list[str]) -> None:
    """Run ``caphy capture-sim`` with the arguments after it."""
    from caphy.capture.session import Plan, capture

    command = tyro.cli(CaptureSim, args=arguments, prog="caphy capture-sim")
    if command.poses is not None and not command.poses.is_dir():
        raise CaphyError(f"{command.poses}: --poses must be a folder of pose files")
    writable_folder(command.out)
    plan = Plan(
        seed=command.seed,
        count=command.count,
        upper=command.upper,
        lower=command.lower,
        clips=None if command.poses is None else str(command.poses),
        body=command.body,
        edge_length=command.edge_length,
        simulate=command.simulate,
        pose_error=command.pose_error,
        optics=command.optics,
    )
    print("dressing the subject ...", flush=True)
    capture(plan, command.out, _Told())
    print(f"{command.out / 'scans'}: {plan.count} scans; the truth is in {command.out / 'truth'}")
    print(f"next: {following('segment', command.out / 'scans')}")


class _Told:
    """Prints progress with an estimate of what is left."""

    def __init__(self) -> None:
        self._seconds: list[float] = []

    def __call__(self, done: int, total: int, seconds: float, report: dict[str, Any]) -> None:
        self._seconds.append(seconds)
        mean = sum(self._seconds) / len(self._seconds)
        left = (total - done) * mean / 60
        unsettled = ", ".join(label for label, how in report.items() if not how["converged"])
        note = f"; not converged: {unsettled}" if unsettled else ""
        print(f"scan {done} of {total}: {seconds:.1f} s; about {left:.0f} min left{note}", flush=True)
