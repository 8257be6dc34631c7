"""Self-contained HTML pages: plots, pictures and a 3-D viewer in one file, without anything from the network."""
