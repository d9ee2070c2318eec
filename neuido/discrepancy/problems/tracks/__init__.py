"""Tracks as problems: free flights, and points on a pendulum, a spring, an axis, a plane or a floor."""
