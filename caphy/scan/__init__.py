"""Scans of clothed people: reading, checks, and which vertex is skin and which is cloth."""
