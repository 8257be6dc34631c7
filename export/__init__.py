"""From trained networks to what is served and shown: ONNX graphs, avatar bundles, animated GLB files."""

import caphy as caphy  # first of all: it keeps onnxruntime from reporting home
