"""The Open Inference Protocol, version 2, over HTTP: what Triton, KServe and their clients speak.

Every garment of every avatar is a model, ``default.tshirt`` say. docs/openinference.md is its text.
"""
