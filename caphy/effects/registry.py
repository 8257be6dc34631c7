"""Finding effects: every file of this package, installed plug-ins (entry point ``caphy.effects``) and a user's file."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil
import sys
from collections.abc import Callable, Mapping, Set
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, wraps
from importlib.metadata import entry_points
from numbers import Real
from pathlib import Path
from types import ModuleType
from typing import get_args

import numpy as np

import caphy.effects
from caphy.effects.base import Effect, ElementKind, Group, Parameter
from caphy.effects.units import dimensions
from caphy.errors import CaphyError, EffectFailed

_from_files: dict[str, type[Effect]] = {}
_file_of: dict[str, Path] = {}
_beside: set[Path] = set()  # folders of the files so far


def _defined_in(module: ModuleType) -> list[type[Effect]]:
    """The effects that a module itself defines."""
    return [
        member
        for member in vars(module).values()
        if inspect.isclass(member)
        and issubclass(member, Effect)
        and member.__module__ == module.__name__
        and "name" in vars(member)
    ]


@cache
def _installed() -> dict[str, type[Effect]]:
    found = [
        effect
        for info in pkgutil.iter_modules(caphy.effects.__path__)
        for effect in _defined_in(importlib.import_module(f"caphy.effects.{info.name}"))
    ]
    found += [entry.load() for entry in entry_points(group="caphy.effects")]
    return {effect.name: effect for effect in found}


def registered_effects() -> dict[str, type[Effect]]:
    """All known effects by name, sorted."""
    return dict(sorted((_installed() | _from_files).items()))


def find_effect(name: str) -> Effect:
    """The effect of a name; raises :class:`CaphyError` with the known names."""
    effects = registered_effects()
    if name not in effects:
        near = get_close_matches(name, effects, 1)
        meant = f" (did you mean {near[0]}?)" if near else ""
        known = ", ".join(effects)
        raise CaphyError(f"there is no effect {name!r}{meant}; known: {known}; add yours with --effect-file")
    return effects[name]()


def _check(effect: type[Effect], path: Path, beside: Set[str]) -> None:
    """Raises :class:`CaphyError` unless a user's effect has a name of its own and what every effect must have.

    ``beside`` are the names of all effects in the same file.
    """
    where = f"{path}: {effect.__name__}"
    _check_declared(effect, where)
    for key, declared in effect.parameters.items():
        if not (isinstance(key, str) and key.isidentifier()):
            raise CaphyError(f"{where}: names of parameters must be letters, digits and _, got {key!r}")
        _check_parameter(f"{where}: parameter {key}", declared)
    if effect.refines is not None and effect.refines not in {*_installed(), *_from_files, *beside} - {effect.name}:
        raise CaphyError(f"{where}: refines must name an effect that there is, got {effect.refines!r}")
    if effect.refines is not None and effect.start is Effect.start:
        raise CaphyError(f"{where}: must define start(self, found), since it refines {effect.refines}")
    if unknown := [key for key in effect.coefficients if key not in effect.parameters]:
        raise CaphyError(f"{where}: coefficients must name parameters ({list(effect.parameters)}), got {unknown}")
    _check_coefficients(effect, where)
    others = [key for key in effect.parameters if key not in effect.coefficients]
    if unknown := [key for key in effect.further if key not in others]:
        raise CaphyError(f"{where}: further must name parameters that are no coefficients ({others}), got {unknown}")
    for key, values in effect.further.items():
        declared = effect.parameters[key]
        if (values and np.shape(declared.default)) or any(not declared.lower <= v <= declared.upper for v in values):
            raise CaphyError(
                f"{where}: further must look for one number {key} in [{declared.lower:g}, {declared.upper:g}] "
                f"{declared.unit}, got {values}"
            )


def _check_coefficients(effect: type[Effect], where: str) -> None:
    for key in effect.coefficients:
        declared = effect.parameters[key]
        if not declared.lower <= 0 <= declared.upper:
            raise CaphyError(
                f"{where}: coefficient {key} must have 0 within its bounds, where the effect is absent and from where "
                f"a diagnosis looks for it, got [{declared.lower:g}, {declared.upper:g}] {declared.unit}; widen them, "
                "or leave it out of coefficients"
            )


def _check_declared(effect: type[Effect], where: str) -> None:
    if not isinstance(effect.name, str) or not effect.name.isidentifier():
        raise CaphyError(f"{where}: name must be like my_effect (a Python name), got {effect.name!r}")
    if effect.name in _installed():
        raise CaphyError(f"{where}: there already is an effect {effect.name!r}; give yours another name")
    if getattr(effect, "element", None) not in get_args(ElementKind):
        raise CaphyError(f"{where}: element must be one of {', '.join(get_args(ElementKind))}")
    if effect.group not in get_args(Group):
        raise CaphyError(f"{where}: group must be one of {', '.join(get_args(Group))}")
    if not isinstance(getattr(effect, "reference", None), str):
        raise CaphyError(f"{where}: reference must say where the effect comes from")
    if effect.energy is Effect.energy:
        raise CaphyError(f"{where}: must define energy(self, e, p)")
    if not isinstance(effect.lacks, Mapping):
        raise CaphyError(f"{where}: lacks must map names of properties to reasons, got {effect.lacks!r}")
    try:
        effect()
    except Exception as error:
        raise CaphyError(f"{where}: must be made without arguments, but {type(error).__name__}: {error}") from error


def _check_parameter(where: str, declared: Parameter) -> None:
    try:
        default = np.asarray(declared.default, dtype=float)
    except (TypeError, ValueError):
        raise CaphyError(f"{where}: its default must be a number or tuples of them, got {declared.default!r}") from None
    if not all(isinstance(bound, Real) for bound in (declared.lower, declared.upper)):
        raise CaphyError(f"{where}: its bounds must be numbers, got {declared.lower!r} and {declared.upper!r}")
    if not isinstance(declared.unit, str):
        raise CaphyError(f"{where}: its unit must be a string such as 'N s/m^3' or '1', got {declared.unit!r}")
    try:
        dimensions(declared.unit)
    except CaphyError as error:
        raise CaphyError(f"{where}: {error}") from error
    if not ((default >= declared.lower) & (default <= declared.upper)).all():  # nor where one of them is no number
        raise CaphyError(
            f"{where}: its default must lie within its bounds [{declared.lower:g}, {declared.upper:g}], "
            f"got {declared.default}"
        )


def register_file(path: Path) -> list[str]:
    """Register the effects that a user's Python file defines; returns their names.

    As with a script, what lies beside the file can be imported. Raises :class:`CaphyError` where the file cannot be
    taken, or lies beside modules of the same names as those of another effect file's folder.
    """
    spec = importlib.util.spec_from_file_location(f"caphy_effect_{path.stem}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise CaphyError(f"{path}: an effect file must be an existing .py file")
    module = importlib.util.module_from_spec(spec)
    _require_own_modules(path)
    beside = str(path.resolve().parent)
    sys.path.insert(0, beside)
    earlier = sys.modules.get(spec.name)
    sys.modules[spec.name] = module  # where dataclasses look up what is annotated
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        if earlier is None:
            sys.modules.pop(spec.name, None)
        else:
            sys.modules[spec.name] = earlier
        raise CaphyError(f"{path}: cannot be imported: {type(error).__name__}: {error}") from error
    finally:
        with suppress(ValueError):  # the file itself may have put its paths right
            sys.path.remove(beside)
        _beside.add(path.resolve().parent)
        if beside not in sys.path:  # what is imported later, within functions
            sys.path.append(beside)
    effects = _defined_in(module)
    if not effects:
        raise CaphyError(f"{path}: defines no subclass of caphy.effects.base.Effect with a name")
    for effect in effects:
        _check(effect, path, {each.name for each in effects})
        other = _file_of.get(effect.name, path) if effect.name in _from_files else path
        if other.resolve() != path.resolve() or sum(each.name == effect.name for each in effects) > 1:
            raise CaphyError(f"{path}: there is another effect {effect.name!r} in {other}; give one another name")
    for effect in effects:
        _name_failures(effect, path)
    _from_files.update({effect.name: effect for effect in effects})
    _file_of.update({effect.name: path for effect in effects})
    return [effect.name for effect in effects]


def file_of(name: str) -> Path | None:
    """The file that an effect of one's own comes from; none of those that come along."""
    return _file_of.get(name) if name in _from_files else None


def _require_own_modules(path: Path) -> None:
    """Raises :class:`CaphyError` where ``import helper`` would give an effect file the helper of another one."""
    folder = path.resolve().parent
    for file in (*folder.glob("*.py"), *folder.glob("*/__init__.py")):
        name = file.stem if file.parent == folder else file.parent.name
        loaded = getattr(sys.modules.get(name), "__file__", None)
        if loaded and Path(loaded).resolve() != file and _beside.intersection(Path(loaded).resolve().parents):
            raise CaphyError(
                f"{path}: beside it lies a module {name!r}, and another of that name is in use already, {loaded}, by "
                "another effect file; give one of them another name"
            )


def _name_failures(effect: type[Effect], path: Path) -> None:
    """Let what a user's effect raises say whose it is, whenever that happens: in fast motion alone, for instance."""
    theirs = [each for each in effect.__mro__ if each is not object and not each.__module__.startswith("caphy.")]
    methods = {key: value for each in reversed(theirs) for key, value in vars(each).items()}
    for key, value in methods.items():
        if inspect.isfunction(value):
            setattr(effect, key, _naming(value, f"{path}: {effect.name}.{key}", path))


def _naming(function: Callable, where: str, path: Path) -> Callable:
    @wraps(function)
    def called(*arguments: object, **named: object) -> object:
        try:
            return function(*arguments, **named)
        except CaphyError:
            raise
        except (Exception, SystemExit) as error:
            raise EffectFailed(
                f"{where} fails: {type(error).__name__}: {error}; see caphy effects check --effect-file {path}"
            ) from error

    return called
