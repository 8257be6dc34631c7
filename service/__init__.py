"""Serves dressed avatars over HTTP: poses in, skinned garment meshes out. Needs neither torch nor training code."""
