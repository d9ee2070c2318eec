"""What inference may ask of measured data and a model: parameters, recordings, candidates, predictions."""
