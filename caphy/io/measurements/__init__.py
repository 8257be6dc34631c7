"""What was measured: cloth in motion, registered or as point clouds, and force curves of tensile tests."""

from caphy.io.measurements.force_curves import ForceCurve, read_force_curves
from caphy.io.measurements.measurement import Measurement
from caphy.io.measurements.read import read_measurement, write_measurement

__all__ = ["ForceCurve", "Measurement", "read_force_curves", "read_measurement", "write_measurement"]
