"""The first frame of a recording as Gaussians and particles."""
