"""The fabric of a garment from scans of it at rest: the stiffness tables that put the cloth where it was seen."""
