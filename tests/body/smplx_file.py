"""A random body file of the SMPL-X schema, and the published formula as plain loops."""

import numpy as np

from caphy.conventions import JOINT_PARENTS


def random_arrays(vertex_count=30, shape_count=20, seed=0) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    weights = random.uniform(size=(vertex_count, 55)) ** 8
    regressor = random.uniform(size=(55, vertex_count)) ** 4
    parents = np.array(JOINT_PARENTS, dtype=np.int64)
    parents[0] = 2**32 - 1
    return {
        "v_template": random.normal(size=(vertex_count, 3)),
        "f": random.integers(0, vertex_count, size=(2 * vertex_count, 3)).astype(np.uint32),
        "weights": weights / weights.sum(axis=1, keepdims=True),
        "J_regressor": regressor / regressor.sum(axis=1, keepdims=True),
        "shapedirs": 0.05 * random.normal(size=(vertex_count, 3, shape_count)),
        "posedirs": 0.01 * random.normal(size=(vertex_count, 3, 486)),
        "kintree_table": np.stack([parents, np.arange(55)]).astype(np.uint32),
        "hands_componentsl": random.normal(size=(45, 45)),
        "hands_componentsr": random.normal(size=(45, 45)),
        "hands_meanl": 0.1 * random.normal(size=45),
        "hands_meanr": 0.1 * random.normal(size=45),
    }


def rodrigues(vector):
    angle = np.sqrt(sum(float(x) ** 2 for x in vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def posed_by_loops(arrays, pose, transl, shape_coefficients):
    """One frame, vertices (V, 3) and joints (55, 3): SMPL's equations, one vertex, joint and coefficient at a time."""
    rotation = [rodrigues(vector) for vector in pose]
    shaped = np.array(arrays["v_template"], dtype=np.float64)
    for k, coefficient in shape_coefficients.items():
        shaped = shaped + coefficient * arrays["shapedirs"][:, :, k]
    joints = np.array([sum(arrays["J_regressor"][j, i] * shaped[i] for i in range(len(shaped))) for j in range(55)])
    corrected = shaped.copy()
    for j in range(1, 55):
        for row in range(3):
            for column in range(3):
                feature = rotation[j][row, column] - (row == column)
                corrected = corrected + feature * arrays["posedirs"][:, :, 9 * (j - 1) + 3 * row + column]
    world = []
    for j, parent in enumerate(JOINT_PARENTS):
        local = np.eye(4)
        local[:3, :3] = rotation[j]
        local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
        world.append(world[parent] @ local if parent >= 0 else local)
    vertices = np.zeros_like(shaped)
    for i in range(len(shaped)):
        for j in range(55):
            moved = world[j][:3, :3] @ (corrected[i] - joints[j]) + world[j][:3, 3]
            vertices[i] += arrays["weights"][i, j] * moved
    return vertices + transl, np.array([matrix[:3, 3] for matrix in world]) + transl
