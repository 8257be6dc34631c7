"""Fitting a model's parameters to measurements through the solver's own response."""
