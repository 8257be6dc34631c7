"""Comparing models with measurements: where a model fails, when, by how much, and how much of that is noise."""
