"""Serves dressed avatars over HTTP: poses in, skinned garment meshes out. Needs neither torch nor training code."""

import caphy as caphy  # first of all: it keeps onnxruntime from reporting home
