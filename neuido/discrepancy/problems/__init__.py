"""Problems: measured data with a declared model, as the search for missing effects sees them (parameters, recordings, predictions)."""
