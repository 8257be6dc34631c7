"""Caphy learns, per garment, how real clothing moves on a body, and serves it in milliseconds on a CPU."""

__version__ = "0.1.0"
