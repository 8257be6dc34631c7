"""From trained networks to what is served and shown: ONNX graphs, avatar bundles, animated GLB files."""
