"""Measurements with a hidden effect: made by a simulator of their own, answered by a sealed envelope."""
