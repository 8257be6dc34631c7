"""``python -m caphy`` is the ``caphy`` command."""

from __future__ import annotations

from caphy.cli import command

if __name__ == "__main__":
    command()
