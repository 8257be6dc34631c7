"""Clients of the stream, in Python and in JavaScript; both are tested with the same messages."""
