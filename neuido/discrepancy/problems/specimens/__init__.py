"""Material tests as a problem: predictions, candidates, and what the tests themselves say of noise and scatter."""
