"""What ``caphy diagnose`` says to run next is understood by the commands that it names, with nothing left out."""

from __future__ import annotations

import shlex
from pathlib import Path

import tyro

from caphy.commands.compare import Compare
from caphy.commands.diagnose import Diagnose, after_curves, next_command
from caphy.commands.refit import RefitCommand

WALKS = (Path("my walks/a.npz"), Path("my walks/b.npz"))


def given(**options) -> Diagnose:
    return Diagnose("model.json", WALKS, Path("out"), **options)


def parsed(kind: type, command: list[str]):
    """The arguments as a shell would hand them over."""
    return tyro.cli(kind, args=shlex.split(shlex.join(command))[2:])


def test_found_effects_are_refitted_with_all_that_was_given():
    options = {
        "base": (Path("base 1.npz"), Path("base2.npz")),
        "held_out": (Path("later.npz"),),
        "garment": Path("shirt.npz"),
        "body": "body.npz",
        "effect_file": (Path("mine.py"), Path("yours.py")),
    }
    command = next_command("named", ("pressure", "mine"), given(**options))
    assert command[:2] == ["caphy", "refit"]
    refit = parsed(RefitCommand, command)
    assert (refit.model, refit.measurements, refit.add) == ("model.json", WALKS, ("pressure", "mine"))
    assert {name: getattr(refit, name) for name in options} == options
    assert refit.output == Path("out/refitted.json")


def test_parameters_that_were_off_are_shown_where_nothing_was_fitted():
    command = next_command("parameters", (), given(garment=Path("shirt.npz"), held_out=(Path("later.npz"),)))
    assert command[:2] == ["caphy", "compare"]
    compare = parsed(Compare, command)
    assert (compare.model, compare.measurements) == ("out/model.json", (Path("later.npz"),))
    assert (compare.garment, compare.output) == ("shirt.npz", Path("out/compared"))
    assert parsed(Compare, next_command("parameters", (), given())).measurements == WALKS


def test_where_nothing_is_left_to_do_nothing_is_said():
    assert next_command("nothing", (), given()) == []
    assert next_command("none of these", (), given()) == []  # its sentence says how to write an effect


def test_tables_of_tensile_tests_are_refitted_into_a_folder():
    command = next_command("named", ("strain_stiffening", "hysteresis"), given(), "refitted")
    refit = parsed(RefitCommand, command)
    assert refit.add == ("strain_stiffening", "hysteresis") and refit.output == Path("out/refitted")


def test_what_was_found_from_the_second_loading_on_is_not_added_to_all():
    """Softening remembers, so that a refit gives it to used cloth; hysteresis it would give to all loadings."""
    (only,) = after_curves(("hysteresis",), ("softening",), given())
    assert parsed(RefitCommand, shlex.split(only)[1:]).add == ("hysteresis", "softening")
    changed, then = after_curves(("hysteresis",), ("hysteresis",), given())
    assert "caphy refit cannot change hysteresis from the second loading on" in changed
    assert parsed(RefitCommand, shlex.split(then)[1:]).add == ("hysteresis",)
    assert after_curves((), ("hysteresis",), given()) == [changed]
    assert after_curves((), (), given()) == ["next: caphy effects new NAME"]
