"""Work in stages that are done once for the same input and go on where they were stopped."""
