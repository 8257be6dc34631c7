"""Who is captured: a body of random shape with a surface of its own, an upper and a lower garment, and their fabric."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from caphy.body.model import BodyModel
from caphy.conventions import JOINT_NAMES
from caphy.effects.model import Model
from caphy.effects.presets import WORN
from caphy.garment.families import Family, LongSleeve, Shorts, Skirt, Tank, Trousers, Tshirt, make_nearest
from caphy.garment.landmarks import Landmarks
from caphy.garment.template import Garment
from caphy.material.fabrics import fabric, fabric_names
from caphy.report.render import vertex_normals

SHAPE_SPREAD = 0.8
"""Standard deviation of the shape coefficients, which are those of adults in units of their own spread."""
ROUGHNESS = 0.005
"""Standard deviation of the surface displacement along the normal [m]; it stays within three times this."""
ROUGH = 0.036
"""Target edge length of the coarse meshes [m]."""

Upper = Literal["tshirt", "longsleeve", "tank"]
Lower = Literal["trousers", "shorts", "skirt"]


@dataclass(frozen=True, eq=False)
class Fabric:
    """A woven or knitted sheet that no list holds: a measured one made stiffer or softer, heavier or lighter."""

    base: str
    """Measured fabric it was made from."""
    stretch: float
    """Factor on its stretching table."""
    bend: float
    """Factor on its bending table."""
    density: float
    """Area density [kg/m^2]."""

    @property
    def model(self) -> Model:
        """The physics of a garment made of it and worn."""
        known = fabric(self.base)
        elastic = {
            "strain_measured": {"stretching": self.stretch * known.stretching},
            "bending_measured": {"bending": self.bend * known.bending},
        }
        return Model(self.density, {**elastic, **WORN})


@dataclass(frozen=True, eq=False)
class Subject:
    """One person, dressed. Lengths in metres; the body's T-pose is y up, facing +z."""

    body: BodyModel
    """The displaced body; its template is the person's own rest shape, so it is posed without betas."""
    betas: np.ndarray
    """Shape coefficients (10,) before displacement."""
    displacement: np.ndarray
    """Displacement (V, 3) [m] of the rest vertices from the shape's."""
    garments: dict[str, Garment]
    """Garments by label, in the order of dressing: "lower", "upper"."""
    rough: dict[str, Garment]
    """The same cuts in a coarse mesh, on which they are worn into a pose."""
    fabrics: dict[str, Fabric]
    """Fabric of each."""
    families: dict[str, Family]
    """Cut of each, all lengths written out."""


def make_subject(
    body: BodyModel,
    seed: int,
    upper: Upper | None = None,
    lower: Lower | None = None,
    edge_length: float = 0.018,
) -> Subject:
    """A person drawn from a seed, on the shape space of ``body``, in a mesh of ``edge_length`` [m] or little less."""
    random = np.random.default_rng([seed, 1])
    betas = np.clip(random.normal(0, SHAPE_SPREAD, body.shapedirs.shape[2]), -2, 2)
    own, displacement = displaced(body, betas, random)
    marks = Landmarks.of(own)
    families = {"lower": _lower(marks, random, lower, edge_length), "upper": _upper(marks, random, upper, edge_length)}
    made = {label: make_nearest(family, own) for label, family in families.items()}
    return Subject(
        body=own,
        betas=betas,
        displacement=displacement,
        garments={label: garment for label, (_, garment) in made.items()},
        rough={label: _rough(family, own, garment) for label, (family, garment) in made.items()},
        fabrics={label: random_fabric(random) for label in families},
        families={label: family for label, (family, _) in made.items()},
    )


def _rough(family: Family, body: BodyModel, fine: Garment) -> Garment:
    """The same cut in a coarse mesh."""
    return fine if family.edge_length >= ROUGH else make_nearest(replace(family, edge_length=ROUGH), body)[1]


def displaced(body: BodyModel, betas: np.ndarray, random: np.random.Generator) -> tuple[BodyModel, np.ndarray]:
    """The body of shape ``betas`` with bumps of 20 to 60 cm wavelength, and their displacement (V, 3) [m]."""
    vertices, joints = body.rest(betas)
    waves = random.normal(size=(24, 3))
    waves *= 2 * np.pi / random.uniform(0.2, 0.6, (24, 1)) / np.linalg.norm(waves, axis=1, keepdims=True)
    field = np.cos(vertices @ waves.T + random.uniform(0, 2 * np.pi, 24)) @ random.normal(size=24) / np.sqrt(12)
    displacement = (ROUGHNESS * np.clip(field, -3, 3) * _soft_parts(body))[:, None] * vertex_normals(
        vertices, body.faces
    )
    return frozen(body, vertices + displacement, joints), displacement


def frozen(body: BodyModel, vertices: np.ndarray, joints: np.ndarray) -> BodyModel:
    """The body with rest vertices (V, 3) and joints (55, 3) [m] of one person, and no shape space."""
    flat, still = np.zeros((len(vertices), 3, 0)), np.zeros((len(joints), 3, 0))
    return replace(
        body,
        v_template=vertices,
        joints=joints,
        shapedirs=flat,
        joint_shapedirs=still,
        expressiondirs=flat,
        joint_expressiondirs=still,
    )


def _soft_parts(body: BodyModel) -> np.ndarray:
    """How much of the displacement each vertex (V,) takes: none on hands, feet and head."""
    hard = [
        j for j, name in enumerate(JOINT_NAMES) if j >= 22 or any(w in name for w in ("head", "wrist", "ankle", "foot"))
    ]
    return 1 - body.weights[:, hard].sum(axis=1)


def _upper(marks: Landmarks, random: np.random.Generator, kind: Upper | None, edge_length: float) -> Family:
    kind = kind or ("tshirt", "longsleeve", "tank")[random.integers(3)]
    cut = {"tshirt": Tshirt, "longsleeve": LongSleeve, "tank": Tank}[kind]
    arm = float(np.linalg.norm(marks.joint("left_wrist") - marks.joint("left_shoulder")))
    share = {"tshirt": random.uniform(0.3, 0.6), "longsleeve": random.uniform(0.85, 0.98), "tank": 0.0}[kind]
    down = marks.joint("neck")[1] - marks.crotch
    return cut(
        sleeve=share * arm,
        length=down + random.uniform(-0.06, 0.06),
        ease=cut.ease + random.uniform(-0.005, 0.01),
        neck_depth=cut.neck_depth + random.uniform(0, 0.03),
        edge_length=edge_length,
    )


def _lower(marks: Landmarks, random: np.random.Generator, kind: Lower | None, edge_length: float) -> Family:
    kind = kind or ("trousers", "shorts", "skirt")[random.integers(3)]
    inseam = float(marks.crotch - marks.joint("left_ankle")[1])
    if kind == "skirt":
        return Skirt(length=random.uniform(0.45, 0.6), flare=random.uniform(0.15, 0.3), edge_length=edge_length)
    if kind == "shorts":
        return Shorts(leg=random.uniform(0.3, 0.5) * inseam, edge_length=edge_length)
    return Trousers(
        leg=random.uniform(0.8, 0.95) * inseam, leg_ease=random.uniform(0.015, 0.03), edge_length=edge_length
    )


def random_fabric(random: np.random.Generator) -> Fabric:
    """A fabric drawn around one of the measured ones."""
    base = str(random.choice(fabric_names()))
    return Fabric(
        base,
        stretch=float(np.exp(random.uniform(np.log(0.6), np.log(1.6)))),
        bend=float(np.exp(random.uniform(np.log(0.5), np.log(2.0)))),
        density=float(fabric(base).density * random.uniform(0.8, 1.25)),
    )
