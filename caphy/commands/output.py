"""The option that says where a command writes, which has one set of names in all of them."""

from __future__ import annotations

import tyro

OUTPUT = tyro.conf.arg(aliases=["-o", "--out"])
"""Marks a command's field ``output``, which is ``--output`` by its own name."""
