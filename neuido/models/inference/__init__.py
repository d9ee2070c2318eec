"""Inference: from a recorded scene to its law, particles and images."""
