"""Characters on a plate: boxes, heights, counts."""
