"""Cloth on pins or on a body moved by NVIDIA Newton's VBD solver, which shares nothing with ours: another elastic law
(stable neo-Hookean), another integrator, another contact and friction, single precision, and forces of air written here
once more."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import newton
import numpy as np
import warp as wp

Force = Callable[[np.ndarray, np.ndarray, float], np.ndarray]
"""What acts on the vertices (V, 3) [N] at positions (V, 3) [m] and velocities (V, 3) [m/s] at a time [s]."""

FPS = 30
SUBSTEPS = 12
CONTACT = 300.0
"""Stiffness of contact with a body [N/m] of each vertex."""
ITERATIONS = 50
"""Of VBD in each substep; fewer make the cloth softer: with 10, cloth of 625 vertices hangs as if its stiffness were a
third."""


@dataclass(frozen=True)
class Fabric:
    """What the cloth is made of: Lame's numbers [N/m], bending k of E = k l^2 / (8 A) d(angle)^2 [N m], kg/m^2."""

    mu: float = 40.0
    lam: float = 25.0
    bending: float = 6e-5
    density: float = 0.2


@dataclass(frozen=True)
class Skin:
    """A body that moves: faces (G, 3), vertices (B, 3) [m] at a time [s], how far from it cloth stays [m], friction."""

    faces: np.ndarray
    at: Callable[[float], np.ndarray]
    distance: float
    friction: float


class NewtonCloth:
    """A cloth whose pins follow a path, or that is worn on a body."""

    def __init__(
        self, vertices: np.ndarray, faces: np.ndarray, pins: np.ndarray, fabric: Fabric, skin: Skin | None = None
    ) -> None:
        """``vertices`` (V, 3) [m] are at rest."""
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=(0.0, -9.81, 0.0))
        builder.add_cloth_mesh(
            pos=wp.vec3(0.0),
            rot=wp.quat_identity(),
            scale=1.0,
            vel=wp.vec3(0.0),
            vertices=[wp.vec3(*map(float, x)) for x in vertices],
            indices=faces.ravel().tolist(),
            density=fabric.density,
            tri_ke=fabric.mu,
            tri_ka=fabric.lam,
            tri_kd=0.0,
            edge_ke=1.0,
            edge_kd=0.0,
            particle_radius=1e-3 if skin is None else skin.distance,
        )
        if skin is not None:
            mesh = newton.Mesh(skin.at(0.0).astype(np.float32), skin.faces.ravel(), compute_inertia=False)
            shape = newton.ModelBuilder.ShapeConfig(ke=CONTACT, kd=0.0, mu=skin.friction, margin=0.0, gap=0.02)
            builder.add_shape_mesh(-1, mesh=mesh, cfg=shape)
        for pin in pins:
            builder.particle_mass[pin] = 0.0
            builder.particle_flags[pin] &= ~int(newton.ParticleFlags.ACTIVE)
        builder.color(include_bending=True)
        self.model, self.faces, self.pins = builder.finalize(device="cpu"), faces, pins
        self._set_bending(vertices, fabric.bending)
        self.solver = newton.solvers.SolverVBD(self.model, iterations=ITERATIONS, particle_enable_self_contact=False)
        self.states = self.model.state(), self.model.state()
        self.control = self.model.control()
        self.skin, self.contacts = skin, None
        if skin is not None:
            self._surface = mesh.mesh
            self.model.shape_collision_aabb_lower.fill_(-10.0)  # it moves: Newton would look where it was
            self.model.shape_collision_aabb_upper.fill_(10.0)
            self.model.soft_contact_ke, self.model.soft_contact_kd = CONTACT, 0.0
            self.model.soft_contact_mu = skin.friction
            self.collisions = newton.CollisionPipeline(self.model, soft_contact_gap=0.02)
            self.contacts = self.collisions.contacts()

    def _set_bending(self, vertices: np.ndarray, k: float) -> None:
        """Newton bends with 1/2 ke l d(angle)^2 per edge: ke = k l / (4 A), A the area of the edge's two faces."""
        edges = self.model.edge_indices.numpy()
        inner = (edges[:, :2] >= 0).all(1)
        ends = vertices[edges[:, 3]] - vertices[edges[:, 2]]
        doubled = sum(
            np.linalg.norm(np.cross(ends, vertices[edges[:, side]] - vertices[edges[:, 2]]), axis=1) for side in (0, 1)
        )
        properties = self.model.edge_bending_properties.numpy()
        properties[:, 0] = np.where(inner, k * np.linalg.norm(ends, axis=1) / (2 * doubled), 0.0)
        self.model.edge_bending_properties.assign(properties)

    def run(
        self, start: np.ndarray, path: Callable[[float], np.ndarray] | None, since: float, until: float, force: Force
    ) -> np.ndarray:
        """Positions (T, V, 3) [m] in each frame from ``since`` to ``until`` [s], from rest at ``start`` (V, 3).

        ``path`` has the pins' positions (P, 3) [m] at a time.
        """
        now, after = self.states
        now.particle_q.assign(start.astype(np.float32))
        now.particle_qd.zero_()
        dt, film = 1 / (FPS * SUBSTEPS), [start]
        for step in range(round((until - since) * FPS) * SUBSTEPS):
            time = since + (step + 1) * dt
            x, v = now.particle_q.numpy(), now.particle_qd.numpy()
            if path is not None:
                x[self.pins] = path(time)
                v[self.pins] = (path(time) - path(time - dt)) / dt
            self._meet(now, time, dt)
            now.particle_q.assign(x)
            now.particle_f.assign(force(x.astype(float), v.astype(float), time).astype(np.float32))
            self.solver.step(now, after, self.control, self.contacts, dt)
            now, after = after, now
            if (step + 1) % SUBSTEPS == 0:
                film.append(now.particle_q.numpy().astype(float))
        return np.stack(film)

    def _meet(self, state: newton.State, time: float, dt: float) -> None:
        """Move the body, which Newton knows as a shape that changes under its feet, and find what is near it."""
        if self.skin is None:
            return
        there = self.skin.at(time)
        surface = self._surface
        surface.velocities.assign(((there - self.skin.at(time - dt)) / dt).astype(np.float32))
        surface.points.assign(there.astype(np.float32))
        surface.refit()
        self.collisions.collide(state, self.contacts)


class Surface:
    """Areas, normals and mean velocities of faces, for forces that act on them."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        self.faces, self.count = faces, len(vertices)
        a, b, c = vertices[faces.T]
        self.area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        self.share = np.bincount(faces.ravel(), np.repeat(self.area / 3, 3), len(vertices))

    def normals(self, x: np.ndarray) -> np.ndarray:
        a, b, c = x[self.faces.T]
        n = np.cross(b - a, c - a)
        return n / np.linalg.norm(n, axis=1, keepdims=True)

    def shared(self, pressure: np.ndarray) -> np.ndarray:
        """Forces on vertices (V, 3) [N] of forces per rest area on faces (F, 3) [Pa]."""
        force = np.repeat(self.area[:, None] / 3 * pressure, 3, axis=0)
        return np.stack([np.bincount(self.faces.ravel(), force[:, i], self.count) for i in range(3)], 1)


def air(surface: Surface, c: float, wind: np.ndarray, across: bool, power: int) -> Force:
    """Drag c |u|^(power - 1) u per area against the slip u through moving air, across the cloth or along it."""

    def force(x: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
        n, slip = surface.normals(x), v[surface.faces].mean(1) - wind
        over = (slip * n).sum(1, keepdims=True) * n
        slip = over if across else slip - over
        return surface.shared(-c * np.linalg.norm(slip, axis=1, keepdims=True) ** (power - 1) * slip)

    return force


def pressed(surface: Surface, pressure: float) -> Force:
    """A pressure [Pa] along the normal."""
    return lambda x, v, time: surface.shared(pressure * surface.normals(x))


def accelerated(masses: np.ndarray, acceleration: np.ndarray, rate: float) -> Force:
    """A uniform acceleration [m/s^2], and a damping of each vertex by its own mass [1/s]."""
    return lambda x, v, time: masses[:, None] * (acceleration - rate * v)


def nothing(x: np.ndarray, v: np.ndarray, time: float) -> np.ndarray:
    """No force."""
    return np.zeros_like(x)
