"""The steps of a Dockerfile, run in a folder instead of an image: no Docker engine is needed, and no root.

Every absolute path of the file stands below that folder. The base image is this interpreter and the system's tools.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

ABSOLUTE = re.compile(r"(?<![\w./])/(?=[a-z])")
INTERPRETER_CHECK = """
import ensurepip, subprocess, sys
assert sys.version_info >= (3, 11)
subprocess.run([sys.executable, "-c", ""], check=True)
"""
KNOWN = ("FROM", "WORKDIR", "RUN", "COPY", "ENV", "USER", "EXPOSE", "HEALTHCHECK", "CMD")


def instructions(text: str) -> list[tuple[str, str]]:
    """Name and argument of each instruction."""
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    joined = "\n".join(lines).replace("\\\n", " ")
    found = [line.strip().partition(" ") for line in joined.splitlines() if line.strip()]
    return [(name, argument.strip()) for name, _, argument in found]


def unprivileged() -> list[str]:
    """What to put before a command that nobody shall run; nothing where we are nobody ourselves."""
    if os.geteuid() != 0:
        return []
    return ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups", "--no-new-privs"]


def base_interpreter() -> Path:
    """An interpreter that nobody may run: this one may lie in root's own folder."""
    for found in (Path(sys.executable).resolve(), Path("/usr/bin/python3").resolve()):
        command = [*unprivileged(), str(found), "-c", INTERPRETER_CHECK]
        if subprocess.run(command, capture_output=True, check=False).returncode == 0:
            return found
    raise AssertionError("there must be a Python 3.11 or later with ensurepip that user 65534 may run")


@dataclass
class Image:
    """What the steps made: files below ``root``, environment, user, and the commands to run and to probe it with."""

    root: Path
    context: Path
    environment: dict[str, str] = field(default_factory=dict)
    user: str = "root"
    command: list[str] = field(default_factory=list)
    probe: list[str] = field(default_factory=list)
    folder: Path = Path()
    stages: dict[str, Path] = field(default_factory=dict)

    def build(self, text: str) -> None:
        """Run every step."""
        for name, argument in instructions(text):
            assert name in KNOWN, f"the test does not know {name}"
            getattr(self, f"_{name.lower()}")(argument)

    def inside(self, path: str) -> Path:
        """Where a path of the image is."""
        return self.root / path.removeprefix("/") if path.startswith("/") else self.folder / path

    def _from(self, argument: str) -> None:
        _, _, name = argument.partition(" AS ")
        if self.root.exists():  # the stage before; its paths must stay those of the image
            kept = self.root.with_name("stage")
            self.root.rename(kept)
            self.stages[self._stage] = kept
        self._stage = name
        for folder in ("usr/local/bin", "etc"):
            (self.root / folder).mkdir(parents=True)
        for file in ("passwd", "group", "shadow", "gshadow"):
            (self.root / "etc" / file).touch()
        (self.root / "usr/local/bin/python").symlink_to(base_interpreter())
        self.environment = {"PATH": f"{self.root}/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"}
        self.folder, self.user = self.root, "root"

    def _workdir(self, argument: str) -> None:
        self.folder = self.inside(argument)
        self.folder.mkdir(parents=True, exist_ok=True)

    def _run(self, argument: str) -> None:
        command = ABSOLUTE.sub(f"{self.root}/", argument)
        if command.startswith("useradd "):
            command = f"useradd --prefix {self.root} " + command.removeprefix("useradd ")
            if os.geteuid() != 0:
                return
        subprocess.run(["sh", "-euc", command], check=True, cwd=self.folder, env={**self.environment, "HOME": "/"})

    def _copy(self, argument: str) -> None:
        words = shlex.split(argument)
        source = self.context
        if words[0].startswith("--from="):
            source = self.stages[words.pop(0).removeprefix("--from=")]
        *names, target = words
        for name in names:
            if source == self.context:
                assert f"!{name}" in (self.context / ".dockerignore").read_text().split(), f"{name} is ignored"
            place = self.inside(target)
            found = source / name.removeprefix("/")
            if found.is_dir():
                shutil.copytree(found, place, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(found, place / name if target.endswith("/") else place)

    def _env(self, argument: str) -> None:
        for name, value in (word.split("=", 1) for word in shlex.split(argument)):
            moved = ABSOLUTE.sub(f"{self.root}/", value)
            self.environment[name] = moved.replace("$PATH", self.environment["PATH"])

    def _user(self, argument: str) -> None:
        self.user = argument

    def _expose(self, argument: str) -> None:
        assert argument.isdigit()

    def _cmd(self, argument: str) -> None:
        self.command = json.loads(argument)

    def _healthcheck(self, argument: str) -> None:
        self.probe = json.loads(argument.partition(" CMD ")[2].strip())
