"""Names of what 'caphy train' leaves in its folder."""

from __future__ import annotations

from typing import Final

NETWORK: Final = "network.safetensors"
CHECKPOINT: Final = "checkpoint.safetensors"
GARMENT: Final = "garment.npz"
MODEL: Final = "model.json"
METRICS: Final = "metrics.jsonl"
OPTIONS: Final = "options.json"
"""What it was told, paths included, beside the record that an avatar carries on."""
RECORD: Final = "run.json"
"""The record that an avatar carries on."""
