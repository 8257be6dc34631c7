"""Meshes as a stream: poses in and garments out over one WebSocket, with credits, so that nobody falls behind."""
