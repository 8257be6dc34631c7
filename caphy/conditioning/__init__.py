"""Noisy, gappy poses from a camera become calm ones at the model's rate; docs/conditioning.md is the text of it."""

from caphy.conditioning.body import Body
from caphy.conditioning.conditioner import Conditioner
from caphy.conditioning.files import as_seen, condition, condition_sequence, condition_upright
from caphy.conditioning.frame import Did, Frame, Summary
from caphy.conditioning.settings import Conditioning

__all__ = [
    "Body",
    "Conditioner",
    "Conditioning",
    "Did",
    "Frame",
    "Summary",
    "as_seen",
    "condition",
    "condition_sequence",
    "condition_upright",
]
