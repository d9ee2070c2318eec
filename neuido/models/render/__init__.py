"""Gaussian splatting: rasterizer, and Gaussians that move with particles."""
