"""Baselines: other methods behind the interface of `Method`."""
