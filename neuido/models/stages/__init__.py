"""The Lightning modules of all training stages."""
