"""Fixtures of the training tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from small_world import small_trainer

from caphy.training.loop import Trainer


@pytest.fixture
def make_trainer(tmp_path: Path) -> Callable[..., Trainer]:
    """Makes trainers of the small world, each in a folder of its own unless told otherwise."""
    return lambda name="run", **options: small_trainer(tmp_path / name, **options)
