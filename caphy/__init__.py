"""Caphy learns, per garment, how real clothing moves on a body, and serves it in milliseconds on a CPU."""

import os

# onnxruntime's packages report sessions, models and errors to Microsoft and keep a device id in the user's cache,
# unless this is set before they are loaded. Whoever wants that sets it to 0.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

__version__ = "0.1.0"
