"""Bodies, trajectories and scenes."""
