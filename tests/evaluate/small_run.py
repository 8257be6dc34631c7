"""A small run to evaluate: two tubes of cloth round the bundled body, scans that show them, and networks as trained."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from small_scans import posed
from small_world import swaying, tube

from caphy.body.bundled import default_body
from caphy.evaluate.dressed import KINDS
from caphy.evaluate.learnt_from import CONTENTS
from caphy.garment.template import Garment, write_npz
from caphy.io.training_folder import NETWORK, OPTIONS
from caphy.kept import digest
from caphy.network.files import save_network
from caphy.network.garment_network import GarmentNetwork
from caphy.register.points import ScanPoints, read_points
from caphy.register.subject import SUBJECT_BODY, body_arrays
from caphy.scan.scan import LABEL_NAMES, Scan
from caphy.scan.scan_set import ScanSet, write_scan_set

SPLIT = {"train": ["scan0", "scan1"], "held_out": ["scan2", "scan3"]}


def garments() -> dict[str, Garment]:
    """A tube round the hips and a wider one over it."""
    lower = tube()
    above = lower.vertices * [1.1, 1, 1.1] + [0, 0.22, 0]
    return {"lower": lower, "upper": replace(lower, name="shirt", vertices=above)}


def small_run(folder: Path) -> tuple[Path, ScanSet]:
    """A run's folder as 'caphy register' fills it, of two scans to train on and two held out, and these scans."""
    run = folder / "run"
    write_npz(run / SUBJECT_BODY, body_arrays(default_body()))
    for kind, garment in garments().items():
        garment.save(run / f"{kind}.npz")
    scans, motion = [], swaying(40, 3)
    for index, name in enumerate(SPLIT["train"] + SPLIT["held_out"]):
        pose, transl = motion.poses[9 * index], motion.transl[9 * index]
        scan = _scan(name, pose, transl)
        parts = {part: scan.vertices[scan.labels == i].astype(np.float32) for i, part in enumerate(LABEL_NAMES)}
        ScanPoints(name, pose=pose, transl=transl, **parts).save(run / "points")
        scans.append(scan)
    (run / "split.json").write_text(json.dumps(SPLIT))
    return run, write_scan_set(folder / "scans", scans, "somebody")


def _scan(name: str, pose: np.ndarray, transl: np.ndarray) -> Scan:
    body = default_body()
    meshes = [(body.pose(pose[None], transl[None])[0], body.faces)]
    for garment in (garments()[kind] for kind in KINDS):
        meshes.append((posed(garment.vertices, garment.weights, pose, transl), garment.faces))
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    labels = np.repeat(np.arange(3, dtype=np.uint8), np.diff(starts))
    faces = np.concatenate([faces + start for (_, faces), start in zip(meshes, starts, strict=False)])
    return Scan(name, np.concatenate([vertices for vertices, _ in meshes]), faces.astype(np.int32), labels=labels)


def write_networks(folder: Path, run: Path, learnt_from: str | None = "", init: str | None = None, bias=0.0) -> Path:
    """Networks of both garments in a folder, as 'caphy train' leaves them.

    learnt_from: digest of the scans they were trained on; those of the run unless given, none for no scans. bias: of
    the last layer [m].
    """
    given = digest(read_points(run, "train")) if learnt_from == "" else learnt_from
    for kind, garment in garments().items():
        network = GarmentNetwork(garment.vertices, garment.weights, default_body().joints, layers=1, width=8)
        with torch.no_grad():
            network.head.bias += bias
        save_network(network, folder / kind / NETWORK)
        told = {"scans": None if given is None else str(run), "init": init, CONTENTS: {"scans": given}}
        (folder / kind / OPTIONS).write_text(json.dumps(told))
    return folder
