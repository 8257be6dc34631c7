"""Diagnosis and refit on force curves of tensile tests."""

from caphy.tensile.diagnosis import CurveDiagnosis, diagnose_curves
from caphy.tensile.refit import CurveRefit, refit_curves

__all__ = ["CurveDiagnosis", "CurveRefit", "diagnose_curves", "refit_curves"]
