"""``caphy diagnose`` and ``caphy refit`` on .csv tables of tensile tests: read, answer, write, say what was written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from caphy.effects.model import Model
from caphy.io.measurements import ForceCurve, read_force_curves
from caphy.kept import Kept
from caphy.tensile.diagnosis import CurveDiagnosis, diagnose_curves
from caphy.tensile.refit import CurveRefit, refit_curves
from caphy.tensile.report import write


def diagnose_tables(
    model: Model, tables: Sequence[Path], output: Path, held_out: Sequence[Path], kept: Kept, file: str
) -> CurveDiagnosis:
    """Diagnose a model, of a file or name, from tables of force curves; raises :class:`caphy.errors.CaphyError`."""
    from tqdm import tqdm

    with tqdm(desc="fits", unit="fit", leave=False) as bar:

        def say(what: str) -> None:
            bar.update()
            bar.set_postfix_str(what)

        answer = diagnose_curves(model, _curves(tables), _curves(held_out), say, kept)
    _finish(answer, output, model, tables, file)
    return answer


def refit_tables(
    model: Model, tables: Sequence[Path], output: Path, held_out: Sequence[Path], add: Sequence[str], kept: Kept,
    file: str,
) -> CurveRefit:  # fmt: skip
    """Refit a model, of a file or name, with effects added to tables of force curves; raises
    :class:`caphy.errors.CaphyError`."""
    found = refit_curves(model, _curves(tables), _curves(held_out), add, kept)
    _finish(found, output, model, tables, file)
    return found


def _curves(tables: Sequence[Path]) -> list[ForceCurve]:
    return [curve for table in tables for curve in read_force_curves(table)]


def _finish(result: CurveDiagnosis | CurveRefit, output: Path, model: Model, tables: Sequence[Path], file: str) -> None:
    title = f"Tensile tests: {', '.join(table.stem for table in tables)}"
    paths = write(result, output, title, model, [table.stem for table in tables], [Path(file)])
    cautions = result.outcome.cautions if isinstance(result, CurveRefit) else result.cautions
    print("\n".join([*result.sentences, *(f"Caution: {caution}" for caution in cautions)]))
    print("\n" + "\n".join(map(str, paths)))
