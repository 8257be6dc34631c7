"""Run benchmarks, each in a process of its own: ``python -m benchmarks [NAME...]``; without names those of minutes."""

from __future__ import annotations

import os
import pkgutil
import subprocess
import sys

import benchmarks

ASIDE = (
    "collision",
    "depth",
    "diagnosis",
    "diagnosis_picture",
    "fabric",
    "girths",
    "monocular",
    "newton",
    "papertable",
    "register",
    "relaxed",
    "screening",
    "segmentation",
    "solver_floor",
    "supervised",
)
"""These take long or need arguments; run only by name, by themselves or by a target of their own."""

ENVIRONMENTS = {"solver_speed": {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}}
"""Variables for some of them: the solver's matrices are small, and two threads take twice its processor time."""


def main(names: list[str]) -> int:
    known = [
        info.name for info in pkgutil.iter_modules(benchmarks.__path__) if not info.name.startswith(("_", "monocular_"))
    ]
    unknown = [name for name in names if name not in known]
    if unknown:
        print(f"there is no benchmark {unknown[0]!r}; known: {', '.join(known)}", file=sys.stderr)
        return 2
    failed = []
    for name in names or [name for name in known if name not in ASIDE]:
        print(f"\n== {name}", flush=True)
        environment = os.environ | ENVIRONMENTS.get(name, {})
        if subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], env=environment, check=False).returncode:
            failed.append(name)
    if failed:
        print(f"\nfailed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
