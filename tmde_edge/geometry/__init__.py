"""Pure projective geometry: pinhole camera, planar pose, homographies."""
