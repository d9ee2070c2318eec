"""The closed loop: from measured data to the effect that a model lacks."""
