"""``caphy register body|garments|points``: the body under the clothes of scans, what is worn, what to train on."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from caphy.commands.body import load_body
from caphy.commands.other_garments import still_told
from caphy.commands.output import OUTPUT
from caphy.commands.seed import require_seed
from caphy.commands.unfinished import UNFINISHED, unfinished
from caphy.errors import CaphyError
from caphy.kept import Kept, digest

if TYPE_CHECKING:
    from caphy.body.model import BodyModel
    from caphy.effects.cloth import Cloth
    from caphy.effects.model import Model
    from caphy.garment.families import Family
    from caphy.garment.template import Garment
    from caphy.register.articulation import Figure, Placement
    from caphy.register.chamfer import Target
    from caphy.register.cloud import Cloud
    from caphy.register.fit import BodyFit, Taken
    from caphy.register.points import ScanPoints
    from caphy.register.template import Choice
    from caphy.scan.scan import Scan
    from caphy.scan.scan_set import ScanSet


KEPT_POINTS = 24_000
"""Points of each scan kept in memory while all are fitted."""


@dataclass(frozen=True)
class Body:
    """Find shape, displacement and poses of the body in labelled scans; goes on where a stopped run was."""

    scans: tyro.conf.Positional[Path]
    """Folder of scans with a scans.toml; see docs/scans.md."""
    output: Annotated[Path, OUTPUT]
    """Folder for body.npz, body.json, body.png and what a later run goes on from."""
    labels: Path | None = None
    """Folder of labels (NAME.npy) to use instead of the scans' own."""
    body: str = "medium"
    """An SMPL-X-format npz, or "medium" or "fine" for the bundled body."""
    pictures: int = 4
    """How many scans to picture; 0 for none."""


@dataclass(frozen=True)
class Garments:
    """Choose the garment templates worn in the scans, on the body that 'caphy register body' found.

    Scans that a split.json there holds out are not looked at.
    """

    scans: tyro.conf.Positional[Path]
    """Folder of scans with a scans.toml."""
    output: Annotated[Path, OUTPUT]
    """The folder that 'caphy register body' wrote; gets upper.npz, lower.npz and garments.json."""
    labels: Path | None = None
    """Folder of labels (NAME.npy) to use instead of the scans' own."""
    body: str = "medium"
    """The body that the fit was made with."""
    garments: Annotated[tuple[Literal["upper", "lower"], ...], tyro.conf.arg(aliases=["--kinds"])] = ("upper", "lower")
    """Which to look for."""
    upper_basis: Path | None = None
    """A linear style basis (npz) to choose the upper garment from instead of the parametric ones."""
    lower_basis: Path | None = None
    """A linear style basis (npz) to choose the lower garment from."""
    fabric: str = "gray-interlock"
    """The measured fabric that garments are hung in to tell their eases."""


@dataclass(frozen=True)
class Points:
    """Write the body as a model of its own, and the segmented points of each scan, a fifth of them held out."""

    scans: tyro.conf.Positional[Path]
    """Folder of scans with a scans.toml."""
    output: Annotated[Path, OUTPUT]
    """The folder that 'caphy register body' wrote; gets subject_body.npz, points/ and split.json."""
    labels: Path | None = None
    """Folder of labels (NAME.npy) to use instead of the scans' own."""
    body: str = "medium"
    """The body that the fit was made with."""
    seed: int = 0
    """Decides which scans are held out, where there is no split yet."""


def main(arguments: list[str]) -> None:
    """Run ``caphy register`` with the arguments after it."""
    command = tyro.cli(
        tyro.conf.OmitSubcommandPrefixes[
            Annotated[Body, tyro.conf.subcommand("body")]
            | Annotated[Garments, tyro.conf.subcommand("garments")]
            | Annotated[Points, tyro.conf.subcommand("points")]
        ],
        args=arguments,
        prog="caphy register",
    )
    match command:
        case Body():
            _body(command)
        case Garments():
            _garments(command)
        case Points():
            _points(command)


def _body(command: Body) -> None:
    from caphy.register.fit import fit_bodies
    from caphy.register.result import write_fit
    from caphy.register.store import Store
    from caphy.scan.scan_set import ScanSet

    body, scans = load_body(command.body), ScanSet.read(command.scans, command.labels)
    unread: dict[str, str] = {}
    taken = list(_taken(scans, body, unread))
    if not taken:
        raise CaphyError("\n".join(["none of the scans can be used:", *unread.values()]))
    with Progress() as progress:
        fit = fit_bodies(body, taken, Store(command.output), progress)
    fit.failures.update(unread)
    write_fit(fit, command.output, command.body)
    for message in fit.failures.values():
        print(f"left out: {message}")
    skin = sum(figures.skin_mean for figures in fit.figures) / len(fit.figures)
    outside = sum(figures.outside for figures in fit.figures) / len(fit.figures)
    print(f"{len(fit.names)} of {len(scans)} scans fitted; skin lies {1e3 * skin:.1f} mm from the body in the mean")
    print(f"{100 * outside:.2f} % of the cloth's points have the body more than 2 mm outside them")
    if command.pictures:
        print(_pictured(fit, scans, command))
    print(command.output / "body.npz")


class Progress:
    """A bar with an estimate of the time left for each part of the work, on the error stream."""

    def __init__(self) -> None:
        self._bar, self._what = None, ""

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def __call__(self, what: str, done: int, total: int) -> None:
        from tqdm import tqdm

        if what != self._what:
            self.__exit__()
            self._bar, self._what = tqdm(total=total, desc=what, leave=False), what
        if self._bar is not None:
            self._bar.update(done - self._bar.n)


def _taken(scans: ScanSet, body: BodyModel, unread: dict[str, str]) -> Iterator[Taken]:
    """What can be fitted; what cannot be used goes into ``unread`` and the rest goes on."""
    from caphy.register.cloud import Cloud
    from caphy.register.fit import Taken
    from caphy.scan.checks import require_size

    for i, name in enumerate(scans.names):
        try:
            scan = scans[i]
            require_size(scan)
            yield Taken(Cloud.of(scan).thinned(KEPT_POINTS), _start(scan, scans, body))
        except CaphyError as error:
            unread[name] = str(error)


def _start(scan: Scan, scans: ScanSet, body: BodyModel) -> Placement | None:
    """The scan's initial pose on this body, whose pelvis rests elsewhere than that of the poses' body."""
    from caphy.register.articulation import Placement

    if scan.pose is None or scan.transl is None or scans.poses is None:
        return None
    return Placement.of(scan.pose, scan.transl + scans.poses.pelvis - body.joints[0])


def _pictured(fit: BodyFit, scans: ScanSet, command: Body) -> Path:
    from caphy.register.pictures import fit_sheet
    from caphy.report.render import write_png

    shown = range(0, len(fit.names), max(1, len(fit.names) // command.pictures))[: command.pictures]
    pictured = [scans[scans.names.index(fit.names[i])] for i in shown]
    sheet = fit_sheet(pictured, [fit.vertices(i) for i in shown], fit.figure.body.faces)
    return write_png(sheet, command.output / "body.png")


def _garments(command: Garments) -> None:
    from caphy.effects.presets import fabric_model
    from caphy.evaluate.learnt_from import TEMPLATES
    from caphy.io.places import write_text
    from caphy.register.linear_style import LinearStyle
    from caphy.register.result import read_fit
    from caphy.register.styles import KINDS
    from caphy.scan.scan_set import ScanSet

    body = load_body(command.body)
    fit, scans = read_fit(command.output / "body.npz", body), ScanSet.read(command.scans, command.labels)
    unknown = [name for name in fit.names if name not in scans.names]
    if unknown:
        raise CaphyError(f"{command.scans}: has no scan {unknown[0]!r}, which the body fit has; give the same scans")
    found, model = {}, fabric_model(command.fabric)  # an unknown fabric is told before anything is looked for
    for kind, basis in (("upper", command.upper_basis), ("lower", command.lower_basis)):
        if basis is not None and kind not in command.garments:
            raise CaphyError(f"--{kind}-basis {basis}: --garments leaves the {kind} garment out; give one or the other")
        if basis is not None:
            LinearStyle.load(basis)  # raises where it is none, before hours of the other garment
    shown, record = _shown(command.output, fit.names), command.output / TEMPLATES
    with unfinished(command.output / f"garments-{UNFINISHED}") as folder:
        for kind in sorted(command.garments):  # what is worn beneath comes first
            found[kind] = _garment(command, fit, shown, scans, kind, model, Kept(folder))
            rest = {each: command.output / f"{each}.npz" for each in KINDS if each not in found}
            told = still_told(record, rest) | found  # written each time: the next one may fail
            write_text(record, json.dumps(dict(sorted(told.items())), indent=1, allow_nan=False))


def _garment(
    command: Garments,
    fit: BodyFit,
    shown: Sequence[int],
    scans: ScanSet,
    kind: Literal["upper", "lower"],
    model: Model,
    kept: Kept,
) -> dict:
    """Choose a garment by the scans ``shown``, write it, and tell what was chosen.

    What a run that was stopped had found is not done again.
    """
    from dataclasses import asdict

    from caphy.garment.template import Garment
    from caphy.register.hanging import SCANS
    from caphy.register.linear_style import LinearStyle, choose_linear, linear_garment
    from caphy.register.points import ScanPoints
    from caphy.register.template import COMPARED, choose, distance

    chosen, clouds, targets = _targets(fit, shown, scans, kind)
    names = [fit.names[i] for i in chosen]
    basis, path = command.upper_basis if kind == "upper" else command.lower_basis, command.output / f"{kind}.npz"
    given = kind, command.body, (command.output / "body.npz").read_bytes(), names, clouds
    beneath = command.output / "lower.npz"
    worn = beneath.read_bytes() if kind == "upper" and beneath.is_file() else None
    whole = kept.key("garment", given, model.to_json(), None if basis is None else basis.read_bytes(), worn)
    known = kept.recall(whole)
    if known is not None and path.is_file() and str(known["digest"]) == digest(path.read_bytes()):
        print(f"{path}: chosen by the run that was stopped")
        return json.loads(str(known["told"]))
    if basis is not None:
        style = LinearStyle.load(basis)
        linear = choose_linear(style, fit.figure, targets)
        garment, told = linear_garment(style, linear, fit.figure, kind), {"coefficients": linear.coefficients.tolist()}
        away, looked_at = linear.distance, linear.looked_at
    else:
        with Progress() as progress:
            choice = _chosen(kept, kept.key("style", given), lambda: choose(fit.figure, targets, kind, progress))
            if worn is not None:
                points = [ScanPoints.of(cloud, fit.placements[i]) for cloud, i in zip(clouds, chosen, strict=True)]
                choice = _outermost(choice, Garment.load(beneath), fit.figure, points)
            nearest = [scans[scans.names.index(name)] for name in names[:SCANS]]
            style, garment = _hung(choice, fit.figure, targets[:SCANS], nearest, model, progress, kept)
        told = asdict(style) | {"families": dict(choice.runners_up)}
        away, looked_at = distance(style, fit.figure, targets), choice.looked_at
    garment.save(path)
    _tell_of_layers(command, kind, clouds)
    near = ", ".join(names[:COMPARED])
    print(f"{path}: {garment.name}, {1e3 * away:.1f} mm from {near}; best of {looked_at} styles, refined")
    told = {"garment": garment.name, "scans": names, "distance": away, "looked_at": looked_at, **told}
    kept.keep(whole, {"told": np.array(json.dumps(told)), "digest": np.array(digest(path.read_bytes()))})
    return told


def _leaves_room(path: Path) -> bool:
    """Whether a garment keeps a further distance from the body, as far as can be told; those of linear bases do not."""
    from caphy.garment.template import Garment

    try:
        return bool(Garment.load(path).layer_thickness.any())
    except CaphyError:
        return True


def _tell_of_layers(command: Garments, kind: str, clouds: Sequence[Cloud]) -> None:
    """Say where one garment will find no room beneath or above another that the scans show."""
    from caphy.scan.scan import LOWER

    other = command.output / ("lower.npz" if kind == "upper" else "upper.npz")
    if kind == "upper" and not other.is_file() and any((cloud.labels == LOWER).any() for cloud in clouds):
        print(
            f"note: the scans show a lower garment, for which {command.output / 'upper.npz'} leaves no room, since it "
            "is not chosen yet; choose it first, or both together"
        )
    elif kind == "lower" and other.is_file() and "upper" not in command.garments and _leaves_room(other):
        print(f"note: {other} was chosen before, and leaves room for another garment, if any; choose it anew")


def _targets(
    fit: BodyFit, shown: Sequence[int], scans: ScanSet, kind: str
) -> tuple[list[int], list[Cloud], list[Target]]:
    """Of the scans ``shown`` the plainest that show a garment, by their numbers; others, or unusable ones, are named.

    Raises:
        CaphyError: none shows it.
    """
    from caphy.register.chamfer import Target
    from caphy.register.cloud import Cloud
    from caphy.register.template import SCANS, plainest

    chosen, clouds, targets, lacking = [], [], [], []
    for i in plainest([fit.placements[i] for i in shown], len(shown)):
        number = shown[i]
        try:
            cloud = Cloud.of(scans[scans.names.index(fit.names[number])])
            targets.append(Target.of(cloud, fit.figure.placed(fit.placements[number]), kind))
        except CaphyError as error:
            lacking.append(str(error))
            print(f"left out: {error}")
            continue
        chosen.append(number)
        clouds.append(cloud)
        if len(chosen) == SCANS:
            break
    if not chosen:
        raise CaphyError("\n".join([f"no scan shows the {kind} garment:", *lacking]))
    return chosen, clouds, targets


def _shown(run: Path, names: Sequence[str]) -> list[int]:
    """Numbers of the scans that templates may be chosen by: those to train on, or all where none are held out yet.

    Raises:
        CaphyError: the split is of other scans.
    """
    from caphy.register.points import SPLIT, read_split

    if not (run / SPLIT).is_file():
        print("note: all scans choose, since none is held out yet: 'caphy register points' first holds out a fifth")
        return list(range(len(names)))
    train = read_split(run)["train"]
    shown = [i for i, name in enumerate(names) if name in train]
    if not shown:
        raise CaphyError(
            f"{run / SPLIT}: names none of the scans of the body fit to train on, but {train[0]}; correct it, or "
            "remove it and run 'caphy register points' again"
        )
    return shown


def _chosen(kept: Kept, key: str, choose: Callable[[], Choice]) -> Choice:
    """A choice, or the one that was kept."""
    from dataclasses import asdict

    from caphy.garment.families import FAMILIES
    from caphy.register.template import Choice

    if (known := kept.recall(key)) is not None:
        told = json.loads(str(known["choice"]))
        style = FAMILIES[told["family"]](**told["style"])
        return Choice(style, told["distance"], told["looked_at"], tuple(map(tuple, told["runners_up"])))
    choice = choose()
    told = {"family": choice.style.family, "style": asdict(choice.style), "distance": choice.distance}
    told |= {"looked_at": choice.looked_at, "runners_up": choice.runners_up}
    kept.keep(key, {"choice": np.array(json.dumps(told))})
    return choice


def _outermost(choice: Choice, lower: Garment, figure: Figure, points: Sequence[ScanPoints]) -> Choice:
    """The choice of an upper garment, thick enough for what lies beneath unless the scans show it tucked in."""
    from dataclasses import replace

    from caphy.garment.families import Top
    from caphy.register.layers import over
    from caphy.register.template import dressed_body, made
    from caphy.training.scans import innermost_first, scan_motions

    assert isinstance(choice.style, Top)
    _, upper = made(choice.style, figure)
    worn = {"upper": (upper.vertices, upper.weights), "lower": (lower.vertices, lower.weights)}
    if innermost_first(points, worn, scan_motions(points, dressed_body(figure), [0], 1.0))[0] == "upper":
        return choice
    return replace(choice, style=over(choice.style, lower, figure))


def _hung(
    choice: Choice,
    figure: Figure,
    targets: list[Target],
    scans: list[Scan],
    model: Model,
    progress: Progress,
    kept: Kept,
) -> tuple[Family, Garment]:
    """The chosen style with eases and lengths that hang as the plainest scans show, or its own, and what it makes."""
    from caphy.register.girth import Sheet
    from caphy.register.hanging import hung, hung_style
    from caphy.register.template import made

    def hang(garment: Garment, cloth: Cloth, body: BodyModel, placement: Placement, model: Model) -> np.ndarray:
        given = garment.vertices, garment.faces, garment.weights, garment.layer_thickness, body.v_template
        key = kept.key("hung", given, placement, model.to_json())
        if (known := kept.recall(key)) is not None:
            return known["vertices"]
        vertices = hung(garment, cloth, body, placement, model)
        kept.keep(key, {"vertices": vertices})
        return vertices

    kind = targets[0].kind
    sheets = [Sheet.of(scan, kind) for scan in scans]
    try:
        style = hung_style(choice.style, figure, targets, sheets, model, progress, hang)
        return made(style, figure)
    except CaphyError as error:
        print(f"the {kind} garment is cut without being hung: {error}")
        return made(choice.style, figure)


def _points(command: Points) -> None:
    from caphy.register.points import SPLIT, read_split, write_points
    from caphy.register.result import read_fit
    from caphy.register.subject import write_subject_body
    from caphy.scan.scan_set import ScanSet

    require_seed(command.seed)
    fit = read_fit(command.output / "body.npz", load_body(command.body))
    scans = ScanSet.read(command.scans, command.labels)
    path = write_subject_body(fit, command.output)
    before = read_split(command.output) if (command.output / SPLIT).is_file() else None
    with Progress() as progress:
        failures = write_points(fit, scans, command.output, command.seed, progress)
    for message in failures.values():
        print(f"left out: {message}")
    sides = read_split(command.output)
    if sides == before:
        print(f"note: {command.output / SPLIT} is kept; remove it to draw another by --seed")
    print(f"{path}; points of {len(sides['train'])} scans to train on, {len(sides['held_out'])} held out")
