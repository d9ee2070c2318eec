"""Losses, metrics and scores of motions."""
