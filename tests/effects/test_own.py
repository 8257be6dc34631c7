"""A user's own effects are tried before work depends on them, and told apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_registry import WIND

from caphy.cli import main
from caphy.effects import registry
from caphy.effects.base import Step
from caphy.effects.battery import (
    degenerate_is_finite,
    parameter_slopes,
    parameters_matter,
    same_in_every_frame,
    same_in_every_place,
)
from caphy.effects.candidates import candidates
from caphy.effects.model import Model
from caphy.effects.own import use_file
from caphy.effects.potential import Potential
from caphy.effects.presets import snug_model
from caphy.effects.registry import find_effect, register_file, registered_effects
from caphy.effects.scaffold import write_scaffold
from caphy.effects.sources import sources
from caphy.effects.trial import irregular_cloth, moment
from caphy.errors import CaphyError, Diverged, EffectFailed
from caphy.io.poses import write_poses
from caphy.io.procedural import procedural_motion
from caphy.kept import Kept
from caphy.solve.newton import Newton

ENERGY = '0.5 * e.dt * p["coefficient"] * e.rest["area"] * dot(slip, slip)'


@pytest.fixture(autouse=True)
def _nobody_else_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_from_files", {})


def _written(path: Path, old: str = "", new: str = "") -> Path:
    assert old in WIND
    path.write_text(WIND.replace(old, new) if old else WIND)
    return path


@pytest.mark.parametrize(
    ("energy", "says"),
    [
        (f"float('nan') * {ENERGY}", "must have a finite energy and gradient, but has none on shaken cloth"),
        ('e.rest["area"] * dot(v, v).sqrt()', "but has none on cloth at rest"),
        ('e.rest["area"] * dot(v, v) ** 1.25', "must have a finite Hessian, but has none on cloth at rest; .* write"),
        ("None", "must return the energy of each element"),
        ("1 / 0", r"\.energy fails: ZeroDivisionError: division by zero"),
    ],
)
def test_what_does_not_work_is_said_with_its_file(tmp_path, energy, says):
    path = _written(tmp_path / "mine.py", ENERGY, energy)
    with pytest.raises(CaphyError, match=f"mine.py: my_wind.*{says}.*caphy effects check --effect-file"):
        use_file(path)


@pytest.mark.parametrize("raised", ["ValueError('mine')", "SystemExit(0)"])
def test_what_fails_later_is_said_with_its_file(tmp_path, raised):
    """Not in the trial, but where cloth is faster than there."""
    fast = f"    if float(dot(v, v).detach().max()) > 100:\n            raise {raised}\n        return"
    path = _written(tmp_path / "mine.py", f"    return {ENERGY}", f"{fast} {ENERGY}")
    assert use_file(path) == ["my_wind"]
    cloth = irregular_cloth()
    potential = Potential(Model(cloth.density, {"my_wind": {}}), cloth)
    x = torch.as_tensor(cloth.vertices)
    step = Step.implicit_euler(0.01, x, x)
    with pytest.raises(EffectFailed, match=r"mine\.py: my_wind\.energy fails: .*caphy effects check --effect-file"):
        potential.gradient(x + 0.1, step)


def test_what_works_is_taken(tmp_path):
    assert use_file(_written(tmp_path / "mine.py")) == ["my_wind"]
    assert use_file(tmp_path / "mine.py") == ["my_wind"]  # once more by another command


def test_a_smoothed_power_is_taken(tmp_path):
    energy = 'e.dt * p["coefficient"] * e.rest["area"] * (dot(slip, slip) + 1e-12) ** 1.25'
    assert use_file(_written(tmp_path / "mine.py", ENERGY, energy)) == ["my_wind"]


def test_what_can_never_be_absent_is_no_coefficient(tmp_path):
    above = ("0.0, 100.0", "0.1, 100.0")
    with pytest.raises(CaphyError, match=r"coefficient must have 0 within its bounds, .* absent .*\[0\.1, 100\]"):
        use_file(_written(tmp_path / "mine.py", *above))
    path = tmp_path / "mine.py"
    path.write_text(WIND.replace(*above).replace("    needs_step", "    coefficients = ()\n    needs_step"))
    assert use_file(path) == ["my_wind"]
    assert "my_wind" not in candidates(snug_model())


def test_a_further_parameter_may_be_above_zero(tmp_path):
    """As the frequency of gusts, in which nothing is linear."""
    path = _written(tmp_path / "mine.py", "-50.0, 50.0", "0.0, 50.0")
    path.write_text(path.read_text().replace("(1.0, 0.0, 0.5)", "(1.0, 0.2, 0.5)").replace("0.0, 50.0", "0.1, 50.0"))
    assert use_file(path) == ["my_wind"]


def test_what_is_borrowed_may_borrow_itself(tmp_path):
    """Friction needs contact: whoever reads its coefficient is tried beside both."""
    path = _written(tmp_path / "mine.py", 'p["coefficient"]', 'p["coefficient"] * p["body_friction.coefficient"]')
    path.write_text(path.read_text().replace("    needs_step", '    borrows = ("body_friction",)\n    needs_step'))
    assert use_file(path) == ["my_wind"]


@pytest.mark.parametrize("bounds", ["", ", 0.0, 50.0", ", -50.0, 0.0", ", -0.01, 0.05"])
@pytest.mark.parametrize("drifts", ["v - drift", "v - drift * drift"])
def test_a_parameter_may_be_zero_by_default(tmp_path, bounds, drifts):
    """A linear one, and one around which the energy is even; also where its bounds begin or end there."""
    path = _written(
        tmp_path / "mine.py",
        '"wind": Parameter((1.0, 0.0, 0.5), "m/s", -50.0, 50.0, linear=False, doc="velocity of the air"),',
        f'"drift": Parameter(0.0, "m/s"{bounds}, linear=False, doc="velocity of the air"),',
    )
    path.write_text(
        path.read_text().replace(
            'slip = v - p["wind"].reshape(3, *(1,) * (v.dim() - 1))', f'drift = p["drift"]\n        slip = {drifts}'
        )
    )
    assert use_file(path) == ["my_wind"]
    parameters_matter("my_wind")
    parameter_slopes("my_wind")


def test_a_linear_parameter_may_be_zero_by_default(tmp_path):
    for bounds in ("", ", 0.0, 50.0"):
        path = _written(
            tmp_path / "mine.py",
            '"wind": Parameter(',
            f'"push": Parameter(0.0, "N/m^2"{bounds}, doc="pull"),\n        "wind": Parameter(',
        )
        path.write_text(path.read_text().replace(ENERGY, f'{ENERGY} - e.dt * p["push"] * e.rest["area"] * v[1]'))
        assert use_file(path) == ["my_wind"]
        parameters_matter("my_wind")
        parameter_slopes("my_wind")


def test_two_effects_of_one_name_are_told(tmp_path):
    register_file(_written(tmp_path / "mine.py"))
    with pytest.raises(CaphyError, match=r"there is another effect 'my_wind' in .*mine\.py"):
        register_file(_written(tmp_path / "other.py"))
    twice = tmp_path / "twice.py"
    twice.write_text((WIND + WIND.replace("MyWind", "Other")).replace('"my_wind"', '"twofold"'))
    with pytest.raises(CaphyError, match="there is another effect 'twofold'"):
        register_file(twice)


@pytest.mark.parametrize(
    ("new", "says"),
    [
        ("name = 7", "name must be like my_effect"),
        ('name = "my effect!"', "name must be like my_effect"),
        ('name = "my_wind"\n    lacks = ["finite"]', "lacks must map"),
        ('name = "my_wind"\n\n    def __init__(self, size):\n        self.size = size', "made without arguments"),
    ],
)
def test_effects_of_the_wrong_kind_are_refused(tmp_path, new, says):
    with pytest.raises(CaphyError, match=says):
        register_file(_written(tmp_path / "mine.py", 'name = "my_wind"', new))


def test_a_place_in_the_world_is_told_from_a_direction(tmp_path):
    """A force read at the velocity that is solved for is multiplied by the place when it is differentiated."""
    push = 'e.rest["area"] * p["coefficient"] * (slip[0] * e.x[0, 0])'
    register_file(_written(tmp_path / "mine.py", ENERGY, push))
    with pytest.raises(AssertionError):
        same_in_every_frame("my_wind")
    with pytest.raises(AssertionError, match="force in another place"):
        same_in_every_place("my_wind")
    lagged = push.replace("slip[0]", "e.lagged_velocity[0, 0]")
    register_file(_written(tmp_path / "mine.py", ENERGY, lagged))
    same_in_every_place("my_wind")


def test_cloth_at_rest_must_be_finite_too(tmp_path):
    register_file(_written(tmp_path / "mine.py", ENERGY, 'e.rest["area"] * dot(v, v).sqrt()'))
    with pytest.raises(AssertionError, match="cloth at rest"):
        degenerate_is_finite("my_wind")


@pytest.mark.parametrize("name", ["_", "_1", "true", "none", "false"])
def test_a_scaffold_is_python(tmp_path, name):
    with pytest.raises(CaphyError, match="no word of Python's"):
        write_scaffold(name, tmp_path / "effect.py")
    assert not list(tmp_path.iterdir())


def test_a_scaffold_is_a_py_file(tmp_path):
    with pytest.raises(CaphyError, match=r"must be a \.py file"):
        write_scaffold("lift", tmp_path / "lift.txt")


def test_what_an_effect_never_rightly_lacks_is_not_advised(tmp_path, capsys):
    path = _written(tmp_path / "mine.py", ENERGY, f"float('nan') * {ENERGY}")
    assert main(["effects", "check", "--effect-file", str(path)]) == 1
    assert '"finite": "why"' not in capsys.readouterr().out
    assert main(["effects", "show"]) == 2
    assert "name the effects to show" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["gradient", "hessian"])
def test_derivatives_of_something_else_are_refused(tmp_path, name):
    """A class that inherits closed forms and changes the energy alone: what is fitted would not be what it says."""
    path = tmp_path / "mine.py"
    path.write_text(
        "from caphy.effects.air_drag_normal import AirDragNormal\n"
        "from caphy.effects.base import Effect\n\n\n"
        "class Ten(AirDragNormal):\n"
        '    """Ten times the drag, E = 10 dt c A / 2 (v.n)^2 [J] per face."""\n\n'
        '    name = "ten_drag"\n\n'
        "    def energy(self, e, p):\n        return 10 * super().energy(e, p)\n"
        + ("\n    gradient = Effect.gradient\n" if name == "hessian" else "")
    )
    with pytest.raises(CaphyError, match=rf"mine\.py: ten_drag must have a gradient and a Hessian.*(?i:{name}) "):
        use_file(path)
    path.write_text(path.read_text().replace("10 * super()", "super()"))
    assert use_file(path) == ["ten_drag"]


def test_names_of_parameters_have_no_dots(tmp_path):
    """By which those that other effects lend are told."""
    path = tmp_path / "mine.py"
    path.write_text(WIND.replace("coefficient", "co.efficient"))
    with pytest.raises(CaphyError, match=r"names of parameters must be letters, digits and _, got 'co\.efficient'"):
        register_file(path)


def test_what_does_nothing_to_a_small_cloth_still_has_derivatives_of_its_own(tmp_path):
    """That it is called idle there must not hide that it is not."""
    path = tmp_path / "mine.py"
    path.write_text(
        "from caphy.effects.air_drag_normal import AirDragNormal\n\n\n"
        "class Ten(AirDragNormal):\n"
        '    """Ten times the drag, E = 10 dt c A / 2 (v.n)^2 [J] per face."""\n\n'
        '    name = "ten_drag"\n    lacks = {"finite": "acts on hems alone"}\n\n'
        "    def energy(self, e, p):\n        return 10 * super().energy(e, p)\n"
    )
    with pytest.raises(CaphyError, match=r"mine\.py: ten_drag must have a gradient and a Hessian"):
        use_file(path)


def test_an_effect_that_the_model_lacks_is_not_simulated_without_a_word(tmp_path, capsys):
    """It would be registered, and the garment moved without it."""
    made, poses, path = tmp_path / "shorts.npz", tmp_path / "walk.npz", _written(tmp_path / "mine.py")
    assert main(["garment", "make", "shorts", "--edge-length", "0.05", "-o", str(made)]) == 0
    write_poses(procedural_motion(0, 0.1), poses)
    words = ["simulate", str(made), str(poses), "-o", str(tmp_path / "o.npz"), "--effect-file", str(path)]
    assert main(words) == 2
    assert "mine.py: the model has no my_wind, so it would not act" in capsys.readouterr().err
    with_it = tmp_path / "model.json"
    with_it.write_text(snug_model().with_effect("my_wind").to_json())
    assert main([*words, "--model", str(with_it), "--seconds", "0.03"]) == 0


def test_what_is_no_number_in_fast_motion_is_named(tmp_path):
    path = _written(tmp_path / "mine.py", f"return {ENERGY}", f"return {ENERGY} * (1 - dot(v, v) / 1e4).sqrt()")
    assert use_file(path) == ["my_wind"]
    cloth = irregular_cloth()
    rest = torch.as_tensor(cloth.vertices)
    model = Model(cloth.density, {"inertia": {}, "my_wind": {}})
    with pytest.raises(Diverged, match=rf"but my_wind is not there; look for .* in my_wind in {path}"):
        Newton(Potential(model, cloth)).minimise(rest + 10.0, Step.implicit_euler(1 / 30, rest, rest))


def test_what_is_inherited_and_fails_is_said_with_its_file(tmp_path):
    raised = "    if float(dot(v, v).detach().max()) > 100:\n            raise ValueError('mine')\n        return"
    path = _written(tmp_path / "mine.py", f"    return {ENERGY}", f"{raised} {ENERGY}")
    path.write_text(
        path.read_text().replace("class MyWind", "class Windy").replace('    name = "my_wind"\n', "")
        + '\n\nclass MyWind(Windy):\n    """Another, E as its own [J]."""\n\n    name = "my_wind"\n'
    )
    assert use_file(path) == ["my_wind"]
    cloth = irregular_cloth()
    rest = torch.as_tensor(cloth.vertices)
    step = Step.implicit_euler(1 / 30, rest, rest)
    with pytest.raises(EffectFailed, match=r"mine\.py: my_wind\.energy fails: ValueError: mine"):
        Potential(Model(cloth.density, {"my_wind": {}}), cloth).gradient(rest + 1.0, step)


@pytest.mark.parametrize(
    ("returned", "says"),
    [
        ("self.hessian(e, p)[0]", "projected_hessian must have the shape of hessian"),
        ("-1000 * self.hessian(e, p)", "without negative eigenvalues"),
        ("1e-6 * self.hessian(e, p)", "must keep the stiff directions"),
    ],
)
def test_projections_that_mislead_the_solver_are_refused(tmp_path, returned, says):
    path = _written(
        tmp_path / "mine.py",
        "    def rest(",
        f"    def projected_hessian(self, e, p):\n        return {returned}\n\n    def rest(",
    )
    with pytest.raises(CaphyError, match=f"mine.py: my_wind.*{says}"):
        use_file(path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ('"N s/m^3"', "None", "its unit must be a string"),
        ("0.0, 100.0", "None, None", "its bounds must be numbers, got None and None"),
        (
            '    element = "vertex"',
            '    element = "vertex"\n    coefficients = ("no",)',
            "coefficients must name parameters",
        ),
    ],
)
def test_declarations_that_mean_nothing_are_refused(tmp_path, old, new, says):
    with pytest.raises(CaphyError, match=f"mine.py: .*{says}"):
        use_file(_written(tmp_path / "mine.py", old, new))


@pytest.mark.parametrize("numbers", ["1.0 * cloth.hinges[:, :1]", "cloth.vertices[:, :1] > 0"])
def test_elements_are_numbered_by_whole_numbers(tmp_path, numbers):
    index = f"    def index(self, cloth):\n        return {numbers}\n\n    def rest("
    with pytest.raises(CaphyError, match="my_wind: index must give numbers of vertices, whole ones"):
        use_file(_written(tmp_path / "mine.py", "    def rest(", index))


LAW = '''
from caphy.effects.base import Parameter
from caphy.effects.membrane import Membrane


class MyLaw(Membrane):
    """Threads that stiffen, E = A k / 2 G_uu^2 [J] per face."""

    name = "my_law"
    parameters = {"stiffness": Parameter(30.0, "N/m", 0.0, 1e5, doc="tension per strain")}
    reference = "a user's own"

    def density(self, strain, e, p):
        return 0.5 * p["stiffness"] * strain[0] ** 2
'''
WOVEN = LAW.replace(
    "    def density",
    "    def rest(self, cloth):\n"
    "        return super().rest(cloth) | {'woven': cloth.face_area / cloth.face_area.mean()}\n\n    def density",
).replace("0.5 *", '0.5 * e.rest["woven"] *')


@pytest.mark.parametrize("rest_shape", ["softening", "shrinkage", "shrinkage_directional"])
def test_a_law_of_ones_own_with_constants_of_its_own_is_not_lent(tmp_path, rest_shape):
    (tmp_path / "mine.py").write_text(WOVEN)
    assert use_file(tmp_path / "mine.py") == ["my_law"]
    cloth = irregular_cloth()
    at = moment(cloth)
    effects = {"strain_stvk": {}, rest_shape: {}}
    terms = Potential(Model(cloth.density, {**effects, "my_law": {}}), cloth).term_gradients(at.x, at.step)
    alone = Potential(Model(cloth.density, effects), cloth).term_gradients(at.x, at.step)
    torch.testing.assert_close(terms[rest_shape], alone[rest_shape])


def test_a_law_of_ones_own_is_cut_smaller_with_the_cloth(tmp_path):
    (tmp_path / "mine.py").write_text(LAW)
    use_file(tmp_path / "mine.py")
    cloth, elastic = irregular_cloth(), {"strain_stvk": {}, "my_law": {}}
    cut, x = replace(cloth, material=0.95 * cloth.material), moment(cloth).x
    wanted = Potential(Model(cloth.density, elastic), cut).gradient(x)[1]
    got = Potential(Model(cloth.density, {**elastic, "shrinkage": {"fraction": 0.05}}), cloth).gradient(x)[1]
    torch.testing.assert_close(got, wanted, rtol=1e-9, atol=1e-12)


FOLDS = '''
from caphy.effects.base import Parameter
from caphy.effects.hinge import Hinge, turn


class MyFolds(Hinge):
    """Folds that stiffen, E = k l^2 / (8 A) turn^2 [J] per interior edge."""

    name = "my_folds"
    parameters = {"stiffness": Parameter(3e-5, "N m", 0.0, 1.0, doc="stiffness")}
    reference = "a user's own"

    def bent(self, angle, e, p):
        turned = turn(angle, e.rest["angle"])
        return p["stiffness"] * e.rest["length"] ** 2 / (8 * e.rest["area"]) * turned**2
'''


@pytest.mark.parametrize("borrower", [{"natural_curvature": {"weft": 9.0, "warp": -4.0}}, {"plastic_crease": {}}])
def test_a_law_of_ones_own_rests_curved_and_creases_with_the_cloth(tmp_path, borrower):
    (tmp_path / "mine.py").write_text(FOLDS)
    use_file(tmp_path / "mine.py")
    cloth = irregular_cloth()
    at = moment(cloth)
    parts = {"bending": {"stiffness_weft": 6e-5, "stiffness_warp": 4e-5}, "my_folds": {}, **borrower}
    whole = {"bending": {"stiffness_weft": 9e-5, "stiffness_warp": 7e-5}, **borrower}
    one, other = (Potential(Model(cloth.density, effects), cloth) for effects in (whole, parts))
    torch.testing.assert_close(other.gradient(at.x, at.step), one.gradient(at.x, at.step))
    (tmp_path / "other.py").write_text(
        FOLDS.replace("my_folds", "other_folds").replace("MyFolds", "OtherFolds")
        + "\n    def rest(self, cloth):\n        return super().rest(cloth)\n"
    )
    use_file(tmp_path / "other.py")
    assert "other_folds" not in (find_effect(next(iter(borrower))).lenders(["bending", "other_folds"]) or ())


def test_a_helper_of_another_file_is_not_taken_for_ones_own(tmp_path):
    for place, value in (("a", 1.0), ("b", 100.0)):
        (tmp_path / place).mkdir()
        (tmp_path / place / "helper_of_a_test.py").write_text(f"K = {value}\n")
        path = _written(tmp_path / place / "mine.py", 'name = "my_wind"', f'name = "wind_{place}"')
        path.write_text("from helper_of_a_test import K\n" + path.read_text().replace("0.5 * e.dt", "K * e.dt"))
    assert use_file(tmp_path / "a" / "mine.py") == ["wind_a"]
    with pytest.raises(CaphyError, match=r"b/mine\.py: beside it lies a module 'helper_of_a_test'.*a/helper_of_a_test"):
        use_file(tmp_path / "b" / "mine.py")


def test_what_an_effect_reads_is_a_part_of_it(tmp_path):
    """A table, read late, and a package below; not what else lies there, nor what is written."""
    (tmp_path / "package_of_a_test").mkdir()
    for file in ("package_of_a_test/__init__.py", "package_of_a_test/factor.py", "other.txt", "deep.csv"):
        (tmp_path / file).write_text("F = 1.0\n")
    (tmp_path / "table.json").write_text("0.5")
    path = _written(tmp_path / "mine.py", "cloth.vertex_area", "table() * cloth.vertex_area")
    path.write_text(
        "import json\nfrom pathlib import Path\n\nfrom package_of_a_test.factor import F\n\n\n"
        "def table():\n    Path(__file__).with_name('log').write_text('here')\n"
        "    return json.loads(Path(__file__).with_name('table.json').read_text())\n\n\n" + path.read_text()
    )
    use_file(path)
    found = {str(file.relative_to(tmp_path.resolve())) for file in sources(path)}
    assert found == {"mine.py", "table.json", "package_of_a_test/__init__.py", "package_of_a_test/factor.py"}
    before = Kept(tmp_path / "kept", [path]).key("x")
    (tmp_path / "other.txt").write_text("changed")
    assert Kept(tmp_path / "kept", [path]).key("x") == before
    (tmp_path / "table.json").write_text("0.7")
    assert Kept(tmp_path / "kept", [path]).key("x") != before


def test_the_librarys_coefficients_may_all_be_absent():
    for name, effect in registered_effects().items():
        registry._check_coefficients(effect, name)


THREADS = """
from caphy.effects.base import Parameter
from caphy.effects.membrane import Membrane


class Threads(Membrane):
    \"\"\"Threads whose warp is so many times as stiff, E = A k / 2 (G_uu^2 + r G_vv^2) [J] per face.\"\"\"

    name = "threads"
    group = "stiffness"
    parameters = {
        "stiffness": Parameter(30.0, "N/m", 0.0, 1e8, doc="of the weft"),
        "ratio": Parameter(0.5, "1", 0.0, 100.0, doc="warp over weft"),
    }
    reference = "Hooke"

    def density(self, strain, e, p):
        uu, vv, _ = strain
        return 0.5 * p["stiffness"] * (uu**2 + p["ratio"] * vv**2)
"""


def test_numbers_that_multiply_each_other_are_not_both_linear(tmp_path, monkeypatch):
    """Each is linear alone: tables of tensile tests added them up, and lost what they do together."""
    path = tmp_path / "threads.py"
    path.write_text(THREADS)
    with pytest.raises(CaphyError, match=r"stiffness and ratio are called linear, but .* all but one linear=False"):
        use_file(path)
    with pytest.raises(AssertionError, match="not linear in all together"):
        parameters_matter("threads")
    monkeypatch.setattr(registry, "_from_files", {})
    path = tmp_path / "mended.py"
    path.write_text(THREADS.replace("100.0, doc", "100.0, linear=False, doc"))
    use_file(path)
    parameters_matter("threads")
