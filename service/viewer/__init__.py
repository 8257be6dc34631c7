"""The page at ``/``: an avatar moving in the browser, and pose files dropped onto it."""
