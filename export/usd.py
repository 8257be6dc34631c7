"""USD with time samples: a mesh per garment and one for the body, points at every frame.

Needs the ``usd-core`` package (pip install 'caphy[usd]').
"""

from __future__ import annotations

import contextlib
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from caphy.errors import CaphyError
from caphy.io.bundle import SkinnedMesh
from caphy.io.places import writable_file
from caphy.report.render import CLOTH, SKIN
from export.motion import DressedMotion

SUFFIXES = (".usdc", ".usda", ".usd")


def write_usd(motion: DressedMotion, path: Path) -> Path:
    """Write a stage with metres, y up, and the avatar's frame rate as its time codes; whole or not at all.

    Raises CaphyError where usd-core is not installed, the name does not end in .usdc, .usda, .usd, or no file can be
    written there.
    """
    usd = _pxr("Usd")
    if path.suffix.lower() not in SUFFIXES:
        raise CaphyError(f"{path}: a USD file's name must end in {', '.join(SUFFIXES)}")
    writable_file(path).parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.partial{path.suffix.lower()}")
    partial.unlink(missing_ok=True)
    try:
        stage = usd.Stage.CreateNew(str(partial))
        _describe(stage, motion)
        colours = [SKIN, *(CLOTH * len(motion.bundle.garments))]
        for (name, mesh, vertices), colour in zip(motion.meshes(), colours, strict=False):
            _add_mesh(stage, name, mesh, vertices, colour)
        stage.GetRootLayer().Save()
        del stage
        partial.replace(path)
    except (OSError, _pxr("Tf").ErrorException) as error:  # the disk is full by now
        raise CaphyError(f"{path}: cannot be written ({_reason(error)}); choose another place with --out") from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    return path


def _reason(error: Exception) -> str:
    """What an error says after where in USD's sources it happened."""
    return str(error).strip().splitlines()[-1].rpartition(" : ")[2].strip("'")


def _pxr(name: str) -> Any:
    """A module of usd-core."""
    try:
        return import_module(f"pxr.{name}")
    except ModuleNotFoundError:
        raise CaphyError("USD needs the usd-core package; install it with: pip install 'caphy[usd]'") from None


def _describe(stage: Any, motion: DressedMotion) -> None:
    geometry = _pxr("UsdGeom")
    geometry.SetStageUpAxis(stage, geometry.Tokens.y)
    geometry.SetStageMetersPerUnit(stage, 1.0)
    fps = motion.bundle.fps
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(len(motion) - 1)
    root = geometry.Xform.Define(stage, "/avatar")
    stage.SetDefaultPrim(root.GetPrim())
    stage.GetRootLayer().documentation = f"{motion.bundle.name}; {motion.bundle.licence}"


def _add_mesh(stage: Any, name: str, mesh: SkinnedMesh, vertices: np.ndarray, colour: Any) -> None:
    gf, vt, geometry = _pxr("Gf"), _pxr("Vt"), _pxr("UsdGeom")
    place = f"/avatar/{_pxr('Tf').MakeValidIdentifier(name)}"
    while stage.GetPrimAtPath(place):  # a-b and a_b are one identifier
        place += "_"
    prim = geometry.Mesh.Define(stage, place)
    prim.CreateSubdivisionSchemeAttr(geometry.Tokens.none)
    prim.CreateDoubleSidedAttr(True)
    prim.CreateFaceVertexCountsAttr(vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    prim.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.ravel(), np.int32)))
    prim.CreateDisplayColorAttr([gf.Vec3f(*(float(c) for c in colour))])
    points, extent = prim.CreatePointsAttr(), prim.CreateExtentAttr()
    for frame, posed in enumerate(vertices):
        for time in (frame,) if frame else (frame, _pxr("Usd").TimeCode.Default()):  # which some programs show at first
            points.Set(vt.Vec3fArray.FromNumpy(np.ascontiguousarray(posed, np.float32)), time)
            extent.Set([gf.Vec3f(*posed.min(axis=0).tolist()), gf.Vec3f(*posed.max(axis=0).tolist())], time)
