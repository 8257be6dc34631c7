"""A small CMU-like skeleton and files made from it, written by hand from the published formats."""

from __future__ import annotations

import math

import numpy as np

BONES = {  # ASF name: (cgspeed BVH name, 3dsMax name, parent, direction, length)
    "lowerback": ("LowerBack", "lowerback", "root", (0, 1, 0), 2.0),
    "upperback": ("Spine", "Chest", "lowerback", (0, 1, 0), 2.0),
    "thorax": ("Spine1", "Chest2", "upperback", (0, 1, 0), 2.0),
    "lowerneck": ("Neck", "lowerneck", "thorax", (0, 1, 0), 1.7),
    "upperneck": ("Neck1", "Neck", "lowerneck", (0, 1, 0), 1.7),
    "head": ("Head", "Head", "upperneck", (0, 1, 0), 1.7),
}
for side, sign in (("l", 1), ("r", -1)):
    Long = "Left" if sign > 0 else "Right"
    down = (0.34202 * sign, -0.9396926, 0)
    BONES |= {
        f"{side}hipjoint": (f"{side.upper()}HipJoint", f"{side.upper()}HipJoint", "root", (0.6 * sign, -0.8, 0), 2.2),
        f"{side}femur": (f"{Long}UpLeg", f"{Long}Hip", f"{side}hipjoint", down, 7.2),
        f"{side}tibia": (f"{Long}Leg", f"{Long}Knee", f"{side}femur", down, 7.4),
        f"{side}foot": (f"{Long}Foot", f"{Long}Ankle", f"{side}tibia", (0.0667 * sign, -0.183, 0.981), 2.4),
        f"{side}toes": (f"{Long}ToeBase", f"{Long}Toe", f"{side}foot", (0, 0, 1), 1.2),
        f"{side}clavicle": (f"{Long}Shoulder", f"{Long}Collar", "thorax", (0.94 * sign, 0.34, 0), 3.5),
        f"{side}humerus": (f"{Long}Arm", f"{Long}Shoulder", f"{side}clavicle", (sign, 0, 0), 5.0),
        f"{side}radius": (f"{Long}ForeArm", f"{Long}Elbow", f"{side}humerus", (sign, 0, 0), 3.5),
        f"{side}wrist": (f"{Long}Hand", f"{Long}Wrist", f"{side}radius", (sign, 0, 0), 1.7),
        f"{side}hand": (f"{Long}FingerBase", f"{side}hand", f"{side}wrist", (sign, 0, 0), 0.7),
    }
CHILDREN = {name: [n for n, b in BONES.items() if b[2] == name] for name in ("root", *BONES)}


def order() -> list[str]:
    """Bones, parents first, as both files list them."""
    found, stack = [], ["root"]
    while stack:
        name = stack.pop()
        found.append(name)
        stack += reversed(CHILDREN[name])
    return found[1:]


def random_angles(rng: np.random.Generator, frames: int, spread: float = 25.0) -> dict[str, np.ndarray]:
    """Angles (T, 3) about x, y, z [degrees] of the root and each bone, smooth in time."""
    time = np.arange(frames)[:, None] / max(frames, 1)
    return {
        name: rng.uniform(-spread, spread, 3) * np.sin(2 * np.pi * (time + rng.uniform(0, 1, 3)))
        for name in ("root", *order())
    }


def root_path(frames: int) -> np.ndarray:
    """Root positions (T, 3) in the file's unit."""
    time = np.linspace(0, 1, frames)
    return np.stack([2 * time, 17 + np.sin(6 * time), 20 * time], axis=-1)


def bvh_text(angles: dict[str, np.ndarray], root: np.ndarray, fps: float = 120, max_names: bool = False) -> str:
    """A BVH file in the cgspeed or the 3dsMax spelling."""
    lines, columns = ["HIERARCHY"], []

    def joint(name: str, offset: tuple[float, ...], depth: int) -> None:
        tab = "\t" * depth
        label = "Hips" if name == "root" else BONES[name][1 if max_names else 0]
        lines.append(f"{tab}{'ROOT' if name == 'root' else 'JOINT'} {label}")
        lines.extend([f"{tab}{{", f"{tab}\tOFFSET " + " ".join(f"{x:.9f}" for x in offset)])
        rotations = "Zrotation Yrotation Xrotation"
        channels = f"6 Xposition Yposition Zposition {rotations}" if name == "root" else f"3 {rotations}"
        lines.append(f"{tab}\tCHANNELS {channels}")
        columns.append(name)
        end = (0.0, 0.0, 0.0) if name == "root" else tuple(BONES[name][4] * np.array(BONES[name][3]))
        for child in CHILDREN[name]:
            joint(child, end, depth + 1)
        if not CHILDREN[name]:
            values = " ".join(f"{x:.9f}" for x in end)
            lines.extend([f"{tab}\tEnd Site", f"{tab}\t{{", f"{tab}\t\tOFFSET {values}", f"{tab}\t}}"])
        lines.append(f"{tab}}}")

    joint("root", (0.0, 0.0, 0.0), 0)
    lines += ["MOTION", f"Frames: {len(root)}", f"Frame Time: {1 / fps:.7f}"]
    for frame in range(len(root)):
        values = [*root[frame]]
        for name in columns:
            values += [*angles[name][frame, ::-1]]
        lines.append(" ".join(f"{value:.6f}" for value in values))
    return "\n".join(lines) + "\n"


def asf_text() -> str:
    """The skeleton as ASF; every bone's axis is the identity, so that angles mean the same as in the BVH."""
    lines = [":version 1.10", ":units", "  mass 1.0", "  length 0.45", "  angle deg", ":root"]
    lines += ["   order TX TY TZ RX RY RZ", "   axis XYZ", "   position 0 0 0", "   orientation 0 0 0", ":bonedata"]
    for number, name in enumerate(order(), start=1):
        _, _, _, direction, length = BONES[name]
        lines += ["  begin", f"     id {number}", f"     name {name}"]
        lines += [f"     direction {' '.join(map(str, direction))}", f"     length {length}", "     axis 0 0 0  XYZ"]
        lines += [
            "    dof rx ry rz",
            "    limits (-180 180)",
            "           (-180 180)",
            "           (-180 180)",
            "  end",
        ]
    lines += [":hierarchy", "  begin"]
    lines += [f"    {name} {' '.join(CHILDREN[name])}" for name in ("root", *order()) if CHILDREN[name]]
    return "\n".join([*lines, "  end"]) + "\n"


def amc_text(angles: dict[str, np.ndarray], root: np.ndarray) -> str:
    """The motion as AMC."""
    lines = ["#!OML:ASF", ":FULLY-SPECIFIED", ":DEGREES"]
    for frame in range(len(root)):
        lines.append(str(frame + 1))
        values = [*root[frame], *angles["root"][frame]]
        lines.append("root " + " ".join(f"{value:.6f}" for value in values))
        lines += [f"{name} " + " ".join(f"{v:.6f}" for v in angles[name][frame]) for name in order()]
    return "\n".join(lines) + "\n"


def rotation(axis: str, degrees: float) -> list[list[float]]:
    """A rotation matrix about one axis, from sines and cosines."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return {
        "X": [[1, 0, 0], [0, c, -s], [0, s, c]],
        "Y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
        "Z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
    }[axis]
