"""Gaussian splatting: the rasterizer, and Gaussians that move with particles."""
