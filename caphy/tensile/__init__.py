"""Diagnosis and refit on force curves of tensile tests."""
